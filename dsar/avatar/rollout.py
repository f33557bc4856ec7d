"""Drive an avatar through a motion, one frame in memory at a time."""

import dataclasses
from collections.abc import Collection, Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.guard_report import log_guarded
from dsar.avatar.player import Player
from dsar.avatar.resampling import (
    RolloutTime,
    copy_residuals,
    delivery_transforms,
    interpolate_residuals,
    locate_frames,
)
from dsar.body.model import JOINT_NAMES
from dsar.errors import MotionError
from dsar.geometry.camera_paths import START_FRAME
from dsar.geometry.frame_rates import same_rate
from dsar.network import STREAMS, NetworkOutput, Stream
from dsar.types import Binding, Gaussians, GaussianSequence, GuardedFrame, Motion


def roll_out(
    avatar: Avatar,
    motion: Motion,
    *,
    delivered: Motion | None = None,
    frames: Sequence[int] | None = None,
    streams: Collection[Stream] = STREAMS,
    provenance: dict[str, str] | None = None,
) -> GaussianSequence:
    """Return the avatar's posed Gaussians over a motion, which is at the avatar's frame rate.

    Every frame up to the last requested one is computed, since each follows from the one before;
    only those in `frames` (numbers from 1001 on; None: all) are yielded. Without one of the `streams`
    the network runs as if it had none of its memory: an ablation of a network trained with it.

    Args:
        avatar: Who moves.
        motion: What the network sees.
        delivered: The same motion at the rate of the wanted frames (`dsar.data.motions.files.resample`);
            None: the avatar's. Frames that lie at a time of the rollout's own are those; see
            `dsar.avatar.resampling` for the others.
        frames: Which of the delivered frames.
        streams: The network's memories.
        provenance: Written into every file.

    Raises:
        MotionError: the motion's rate is not the avatar's, the delivery is longer, or a requested frame lies
            outside.
    """
    if not same_rate(motion.fps, avatar.fps):
        raise MotionError(
            f"motion {motion.name} has {motion.fps:g} fps, the avatar {avatar.fps:g}; resample it"
        )
    delivered = motion if delivered is None else delivered
    last = START_FRAME + len(delivered) - 1
    numbers = list(frames) if frames is not None else list(range(START_FRAME, last + 1))
    outside = [n for n in numbers if not START_FRAME <= n <= last]
    if outside or not numbers:
        raise MotionError(
            f"frame {outside[0] if outside else 'range'} is outside motion {motion.name}, "
            f"which has frames {START_FRAME}-{last} at {delivered.fps:g} a second"
        )
    numbers = sorted(set(numbers))
    wanted = [number - START_FRAME for number in numbers]
    signal = avatar.driving_signal(motion)
    times = locate_frames(signal, delivered)
    poses = delivery_transforms(avatar.body, signal, delivered, times)[wanted]
    times = [times[frame] for frame in wanted]
    guarded: dict[int, GuardedFrame] = {}

    def produce() -> Iterator[Gaussians]:
        guarded.clear()
        player = Player(avatar, signal, streams=streams)
        for number, (gaussians, found) in zip(numbers, _deliver(player, times, poses), strict=True):
            if found is not None:
                guarded[number] = found
            yield gaussians
        log_guarded(motion.name, guarded, len(numbers))

    return GaussianSequence(
        frame_numbers=numbers,
        fps=avatar.fps if same_rate(delivered.fps, avatar.fps) else delivered.fps,
        num_gaussians=avatar.num_gaussians,
        produce=produce,
        provenance={"motion": motion.name, **(provenance or {})},
        binding=_bind(avatar, poses),
        guarded=guarded,
    )


def _bind(avatar: Avatar, poses: Float[Tensor, "f j 4 4"]) -> Binding:
    """Return how the avatar hangs on its body where that carries it (T_world_rest of its joints)."""
    width, height = avatar.atlas_size[1], len(avatar.charts[0].rows)
    rows, columns = avatar.texels // width, avatar.texels % width
    # The body's chart fills its texture; charts of garments lie below it.
    uv = torch.stack([(columns + 0.5) / width, 1 - (rows + 0.5) / height], -1)
    # Writers work in main memory, wherever the avatar is.
    return Binding(
        body=avatar.body.to(device="cpu"),
        joint_names=JOINT_NAMES,
        points=avatar.texel_positions.cpu(),
        weights=avatar.texel_weights.cpu(),
        uv=uv.cpu(),
        T_world_rest=poses.cpu(),
    )


def template_sequence(sequence: GaussianSequence, avatar: Avatar, motion: Motion) -> GaussianSequence:
    """Return the same frames of the template under skinning alone: the baseline without a network."""
    signal = avatar.driving_signal(motion)

    @torch.no_grad()
    def produce() -> Iterator[Gaussians]:
        for number in sequence.frame_numbers:
            frame = number - START_FRAME
            yield avatar.gaussians(signal.windows[frame : frame + 1], None)[0]

    return dataclasses.replace(sequence, produce=produce, guarded={})


def network_outputs(
    avatar: Avatar, motion: Motion, *, streams: Collection[Stream] = STREAMS
) -> Iterator[tuple[Float[Tensor, "1 t j 4 4"], NetworkOutput]]:
    """Yield each frame's motion window and what the network makes of it.

    On a GPU an output lasts until the next is asked for.
    """
    player = Player(avatar, avatar.driving_signal(motion), streams=streams)
    for _ in range(len(motion)):
        frame = player.forward_frame()
        yield frame.motion_window, frame.output


def _deliver(
    player: Player, times: Sequence[RolloutTime], transforms: Float[Tensor, "f j 4 4"]
) -> Iterator[tuple[Gaussians, GuardedFrame | None]]:
    """Yield the Gaussians at ascending times of a rollout, and what guards found there.

    `transforms` are the body's, time by time.
    """
    avatar, last = player.avatar, len(player.signal) - 1
    newest, before, found_before = player.forward_frame(), None, None
    for time, pose in zip(times, transforms, strict=True):
        while newest.number < min(time.step + (time.fraction > 0), last):
            before, found_before = copy_residuals(newest.output), newest.guarded
            newest = player.forward_frame()
        found = newest.guarded
        with torch.no_grad():
            if time.fraction == 0:
                gaussians = avatar.gaussians(newest.motion_window, newest.output)[0]
            else:
                # After the last frame its residuals stay.
                residuals = newest.output
                if before is not None and time.step < newest.number:
                    residuals = interpolate_residuals(before, residuals, time.fraction)
                    found = _worse(found_before, found)
                gaussians = avatar.gaussians(pose[None, None], residuals)[0]
        yield gaussians, found


def _worse(one: GuardedFrame | None, other: GuardedFrame | None) -> GuardedFrame | None:
    """Return what was found in either of two frames."""
    return one.merged(other) if one is not None and other is not None else one or other
