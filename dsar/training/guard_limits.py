"""The limits of a run's guards: found by a rollout over the training motions, and kept with the checkpoint.

RUN/checkpoint/guards.safetensors holds them, and the hash of the avatar that they are of. A checkpoint
without it, of an older version or of a training that was stopped, gets it when it is first driven.
"""

import hashlib
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import save
from torch import Tensor

from dsar.atomic_files import atomic_write
from dsar.avatar.avatar import Avatar
from dsar.avatar.driving import DrivingSignal
from dsar.avatar.guard_limits import GuardLimits, Jitter, squared_distances
from dsar.avatar.player import Player
from dsar.errors import DsarError
from dsar.training.checkpoint import Run, load_checkpoint, read_tensors, reading
from dsar.training.scene import Scene

LOGGER = logging.getLogger(__name__)
_LEAST = 1e-3
"""Least limit of what is standardised: a training motion that stands still has no largest speed."""
_LEAST_OUTPUT = 1e-6
"""Least limit of offsets (metres), residuals and jitter."""
_NUMBERS = ("offset", "appearance", "jitter")


def load(folder: str | Path, device: torch.device | str = "cpu") -> Avatar:
    """Return the trained avatar of a run folder, on a device, with its guards where the run keeps them.

    An older run keeps them from the first command on that drives it. `avatar.guard_limits = None` takes them
    off.
    """
    run = Run(Path(folder))
    avatar = load_checkpoint(run, device)[0]
    avatar.guard_limits = read_guard_limits(run)
    return avatar


def attach_guards(run: Run, avatar: Avatar, scene: Callable[[], Scene]) -> None:
    """Give an avatar that was loaded from a run the limits of its guards; find and keep them, if need be.

    Where the run's training motions are not known any more, it gets none, and the log says so.

    Args:
        run: Where the avatar is from.
        avatar: As it was loaded.
        scene: Opens what the run keeps of its capture; called only where the limits are not kept.
    """
    avatar.guard_limits = read_guard_limits(run)
    if avatar.guard_limits is not None:
        return
    try:
        known = scene()
    except DsarError as error:
        LOGGER.warning("No guards: they are measured by training's motions, which are not known: %s", error)
        return
    motions = [known.motions[name] for name in known.splits["train"]]
    LOGGER.info("Measuring the guards' limits once, by %d training frames", sum(map(len, motions)))
    digest = _digest(run)
    avatar.guard_limits = find_guard_limits(avatar, [avatar.driving_signal(motion) for motion in motions])
    try:
        write_guard_limits(run, avatar.guard_limits, digest)
    except DsarError as error:
        LOGGER.warning("The guards' limits are measured again next time, for they cannot be kept: %s", error)


def read_guard_limits(run: Run) -> GuardLimits | None:
    """Return the limits that a checkpoint keeps; None where it has none, or those of another avatar.

    Raises:
        CheckpointError: the file is damaged.
    """
    if not run.guards.exists():
        return None
    tensors = read_tensors(run.guards)
    with reading(run.guards):
        if bytes(tensors["checkpoint"].tolist()) != _digest(run):
            return None
        numbers = {name: float(tensors[name]) for name in _NUMBERS}
        return GuardLimits(tensors["mean"], tensors["distances"], **numbers)


def write_guard_limits(run: Run, limits: GuardLimits, digest: bytes) -> None:
    """Write limits beside the avatar that they are of, which its digest names.

    Raises:
        StorageError: the system does not take it.
    """
    tensors = {
        "checkpoint": torch.tensor(list(digest), dtype=torch.uint8),
        "mean": limits.mean.cpu().contiguous(),
        "distances": limits.distances.cpu().contiguous(),
        **{name: torch.tensor(getattr(limits, name), dtype=torch.float64) for name in _NUMBERS},
    }
    with atomic_write(run.guards) as draft:
        draft.write_bytes(save(tensors))


def _digest(run: Run) -> bytes:
    """Return the hash of a run's avatar."""
    return hashlib.sha256((run.checkpoint / "avatar.safetensors").read_bytes()).digest()


@torch.no_grad()
def find_guard_limits(avatar: Avatar, signals: Sequence[DrivingSignal]) -> GuardLimits:
    """Return what rollouts of a trained avatar over its training motions show.

    Args:
        avatar: Without limits, or with old ones, which are not heeded.
        signals: The training motions.
    """
    count, total = 0, torch.zeros(())
    for signal in signals:
        for maps in _standardized(avatar, signal):
            count, total = count + 1, total.to(maps) + maps[0]
    mean, distances = total / count, None
    largest = {"offset": 0.0, "appearance": 0.0, "jitter": 0.0}
    for signal in signals:
        for maps in _standardized(avatar, signal):
            squares = squared_distances(maps, mean)
            distances = squares if distances is None else torch.maximum(distances, squares)
        for name, value in _largest_outputs(avatar, signal).items():
            largest[name] = max(largest[name], value)
    if distances is None:
        raise ValueError("no training motion has a frame")
    # Of a network that says nothing any offset is too large, but not infinitely.
    largest = {name: max(value, _LEAST_OUTPUT) for name, value in largest.items()}
    return GuardLimits(mean, distances.sqrt().clamp_min(_LEAST), **largest)


def _standardized(avatar: Avatar, signal: DrivingSignal) -> Iterator[Float[Tensor, "1 c h w"]]:
    """Yield the standardised input maps of each frame."""
    for frame in range(len(signal)):
        window, cloth = signal.windows[frame : frame + 1], signal.cloth_at(range(frame, frame + 1))
        yield avatar.standardize(avatar.input_maps(window, avatar.fps, cloth))[0]


def _largest_outputs(avatar: Avatar, signal: DrivingSignal) -> dict[str, float]:
    """Return the largest offset, appearance and jitter of one rollout without guards."""
    player, jitter = Player(avatar, signal, guarded=False), Jitter.at_rate(avatar.fps)
    largest = {"offset": 0.0, "appearance": 0.0, "jitter": 0.0}
    for _ in range(len(signal)):
        output = player.forward_frame().own
        offset = output.offset.clone()
        jitter = jitter.step(offset, float(jitter.change(offset)))
        found = {"offset": float(offset.abs().amax()), "appearance": float(output.appearance.abs().amax())}
        for name, value in {**found, "jitter": jitter.size}.items():
            largest[name] = max(largest[name], value)
    return largest
