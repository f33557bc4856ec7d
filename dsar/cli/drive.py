"""What `dsar export` and `dsar render` share: a trained avatar and the motion that drives it."""

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dsar.cli.common import Common, capture_sequence
from dsar.errors import ConfigError, DsarError
from dsar.types import Body, Camera, GaussianSequence, Motion

if TYPE_CHECKING:
    from dsar.avatar.avatar import Avatar
    from dsar.training.scene import Scene

LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Performance:
    """An avatar, a motion at its rate, and where both come from."""

    avatar: "Avatar"
    motion: Motion
    scene: "Callable[[], Scene]"
    """Opens what the run keeps of its capture, once it is needed."""
    provenance: dict[str, str]
    inputs: dict[str, str]
    """Hashes of what was read, by what it is: checkpoint, model settings, motion."""

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Those of the capture; a DsarError where there is neither it nor what a run keeps of it."""
        return self.scene().cameras

    def roll_out(self, frames: Sequence[int] | None = None) -> GaussianSequence:
        """Return the Gaussians of some frames, all by default."""
        from dsar.avatar import roll_out

        return roll_out(self.avatar, self.motion, frames=frames, provenance=self.provenance)


@dataclass(frozen=True)
class Drive(Common):
    """Flags of commands that drive a trained avatar."""

    run_folder: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(name="run")] = None
    """Run folder; default: the newest under runs/."""
    motion: str = "test"
    """An AMASS/SMPL-X .npz or .bvh file, a sequence of the run's capture, or its split `test` or `train`."""
    frames: str | None = None
    """Frame numbers from 1001 on, e.g. 1001-1100x2; default: all."""

    def wanted_frames(self) -> list[int] | None:
        """Return the frames that are asked for, None for all."""
        from dsar_exporters import parse_frames

        return None if self.frames is None else parse_frames(self.frames)

    def chosen_run(self) -> Path:
        """Return the run folder: the one named, else the newest."""
        from dsar.training.checkpoint import newest_run

        return self.run_folder or newest_run().folder

    def motion_file(self) -> Path | None:
        """Return the file that --motion names; None where it is to be a sequence or split of the capture."""
        path = Path(self.motion)
        named_like_one = path.suffix.lower() in (".npz", ".bvh")
        return path if named_like_one or (path.suffix and path.is_file()) else None

    def open(self) -> Performance:
        """Return the avatar and its motion."""
        import torch

        from dsar.data.motion import read_motion, resample
        from dsar.training.checkpoint import Run, load_checkpoint
        from dsar.training.scene import open_scene

        self.check_device()
        # With more threads sums are added in another order, and bytes would depend on the number of cores.
        torch.set_num_threads(1)
        run, file = Run(self.chosen_run()), self.motion_file()
        avatar, config, provenance = load_checkpoint(run)
        scene = cache(partial(open_scene, run, config))
        if file is None:
            motion = _sequence(scene(), self.motion)
            read = _hash(motion)
        else:
            motion = read_motion(file, avatar.body)
            read = _digest(file.read_bytes())
        if motion.fps != avatar.fps:
            motion = resample(motion, avatar.fps)
        if file is not None:
            _compare_with_training(avatar.body, motion, scene)
        provenance["motion_hash"] = _hash(motion)
        settings = _digest(repr(config.model).encode())
        inputs = {"checkpoint": provenance["checkpoint"], "model": settings, "motion": read}
        return Performance(avatar, motion, scene, provenance, inputs)


def _sequence(scene: "Scene", motion: str) -> Motion:
    """Return the sequence of the capture that --motion names."""
    name = capture_sequence(scene, motion)
    if name is None:
        raise ConfigError(
            f"--motion {motion}: expected a .npz or .bvh file, `test`, `train`, or one of the capture's "
            f"sequences {', '.join(scene.motions)}; found none of them"
        )
    return scene.motions[name]


def _compare_with_training(body: Body, motion: Motion, scene: "Callable[[], Scene]") -> None:
    """Log how far a motion is from those of training, where these are known."""
    from dsar.avatar.rollout import START_FRAME
    from dsar.data.novelty import report_novelty

    try:
        known = [scene().motions[trained] for trained in scene().splits["train"]]
    except DsarError as error:
        LOGGER.warning("Motion %s: not compared with training's, which are not known: %s", motion.name, error)
        return
    report_novelty(body, motion, known, START_FRAME)


def _hash(motion: Motion) -> str:
    """Return a hash of the poses: a file may change and keep its name."""
    values = (motion.rotations, motion.translations)
    return _digest(b"".join(each.cpu().contiguous().numpy().tobytes() for each in values))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
