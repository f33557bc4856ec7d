"""What `dsar export` and `dsar render` share: a trained avatar and the motion that drives it."""

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dsar.cli.command import GuardedCommand, resolve_sequence
from dsar.errors import ConfigError, DsarError
from dsar.geometry.camera_paths import START_FRAME
from dsar.geometry.frame_numbers import parse_frames
from dsar.geometry.frame_rates import exact_rate, parse_rate, same_rate
from dsar.types import Body, Camera, GaussianSequence, Motion

if TYPE_CHECKING:
    from dsar.avatar.avatar import Avatar
    from dsar.training.scene import Scene

LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class DrivenAvatar:
    """An avatar, a motion at its rate and at that of the delivery, and where they come from."""

    avatar: "Avatar"
    motion: Motion
    delivered: Motion
    """The same at the rate of the frames that are written."""
    scene: "Callable[[], Scene]"
    """Opens what the run keeps of its capture, once it is needed."""
    provenance: dict[str, str]
    inputs: dict[str, str]
    """Hashes of what was read, by what it is: checkpoint, model settings, motion."""

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Those of the capture; a DsarError where there is neither it nor what a run keeps of it."""
        return self.scene().cameras

    @cached_property
    def whole(self) -> GaussianSequence:
        """The Gaussians of all frames that are delivered."""
        return self.roll_out()

    def roll_out(self, frames: Sequence[int] | None = None) -> GaussianSequence:
        """Return the Gaussians of some frames, all by default; in main memory, wherever the avatar is."""
        from dsar.avatar import roll_out

        given = {"delivered": self.delivered, "provenance": self.provenance}
        return roll_out(self.avatar, self.motion, frames=frames, **given).in_main_memory()


@dataclass(frozen=True)
class DriveCommand(GuardedCommand):
    """Flags of commands that drive a trained avatar."""

    motion: str = "test"
    """An AMASS/SMPL-X .npz or .bvh file, a sequence of the run's capture, or its split `test` or `train`."""
    up: Literal["y", "z"] | None = None
    """Which axis is up in the motion file; default: found from how people stand in it."""
    motion_fps: str | None = None
    """Frames per second of the motion file, where it says none or a wrong one."""
    fps: str | None = None
    """Frames per second to deliver, e.g. 24, 23.976 or 24000/1001; default: the avatar's."""
    frames: str | None = None
    """Frame numbers from 1001 on, of those delivered, e.g. 1001-1100x2; default: all."""

    def requested_frames(self) -> list[int] | None:
        """Return the frames that are asked for, None for all."""
        return None if self.frames is None else parse_frames(self.frames)

    def check_name(self, name: str) -> None:
        """Raise ConfigError where files called so would leave the folder they are to be in, or be hidden."""
        from dsar.data.folders import check_name

        check_name("--name", name, ConfigError)

    def motion_file(self) -> Path | None:
        """Return the file that --motion names; None where it is to be a sequence or split of the capture."""
        path = Path(self.motion)
        named_like_one = path.suffix.lower() in (".npz", ".bvh")
        return path if named_like_one or (path.suffix and path.is_file()) else None

    def open(self) -> DrivenAvatar:
        """Return the avatar and its motion; from here on torch works with one thread.

        With more threads sums are added in another order, and bytes would depend on the number of cores.
        """
        import torch

        from dsar.data.motions.files import resample
        from dsar.data.motions.out_of_distribution import log_out_of_distribution
        from dsar.training.checkpoint import Run, load_checkpoint
        from dsar.training.scene import open_scene

        device = self.chosen_device()
        torch.set_num_threads(1)
        fps = None if self.fps is None else parse_rate(self.fps)
        run, file = Run(self.chosen_run()), self.motion_file()
        avatar, config, provenance = load_checkpoint(run, device)
        body = avatar.body.to(device="cpu")
        scene, training = cache(partial(open_scene, run, config)), None
        self.guard(run, avatar, scene)
        provenance["guards"] = "off" if avatar.guard_limits is None else "on"
        if file is None:
            self._refuse_file_flags(self.motion)
            motion = _sequence(scene(), self.motion)
            source_hash = _hash(motion)
        else:
            training = _training_motions(scene, file.stem)
            motion = self._read_motion_file(file, body)
            source_hash = _digest(file.read_bytes())
        provenance["motion_hash"] = _hash(motion)
        driven = delivered = resample(motion, avatar.fps)
        if fps is not None and not same_rate(fps, avatar.fps):
            delivered = resample(motion, fps)
            provenance["fps"] = str(exact_rate(fps))
        if training is not None:
            log_out_of_distribution(body, delivered, training, START_FRAME)
        settings = _digest(repr(config.model).encode())
        inputs = {"checkpoint": provenance["checkpoint"], "model": settings, "motion": source_hash}
        return DrivenAvatar(avatar, driven, delivered, scene, provenance, inputs)

    def _read_motion_file(self, file: Path, body: Body) -> Motion:
        """Return the motion of a file, and log what looks wrong with it."""
        from dsar.data.motions.files import read_motion
        from dsar.data.motions.kinematics import trace_joints
        from dsar.data.motions.plausibility import check_plausibility

        fps = None if self.motion_fps is None else parse_rate(self.motion_fps, "--motion-fps")
        motion = read_motion(file, body, up=self.up, fps=fps)
        check_plausibility(trace_joints(body, motion))
        return motion

    def _refuse_file_flags(self, sequence: str) -> None:
        """Raise ConfigError where flags for motion files stand beside a sequence of the capture."""
        given = {"--up": self.up, "--motion-fps": self.motion_fps}
        if flags := [flag for flag, value in given.items() if value is not None]:
            raise ConfigError(
                f"{', '.join(flags)}: for motion files; {sequence} is a sequence of the capture, leave out"
            )


def _sequence(scene: "Scene", motion: str) -> Motion:
    """Return the sequence of the capture that --motion names."""
    name = resolve_sequence(scene, motion)
    if name is None:
        raise ConfigError(
            f"--motion {motion}: expected a .npz or .bvh file, `test`, `train`, or one of the capture's "
            f"sequences {', '.join(scene.motions)}; found none of them"
        )
    return scene.motions[name]


def _training_motions(scene: "Callable[[], Scene]", motion: str) -> list[Motion] | None:
    """Return what an avatar was trained with; None, and say so, where that is not known.

    Args:
        scene: Opens what the run keeps of its capture.
        motion: Name of the motion that is to be compared with it.
    """
    try:
        return [scene().motions[name] for name in scene().splits["train"]]
    except DsarError as error:
        LOGGER.warning("Motion %s: not compared with training's, which are not known: %s", motion, error)
        return None


def _hash(motion: Motion) -> str:
    """Return a hash of the poses and their rate: a file may change and keep its name."""
    values = [
        tensor.cpu().contiguous().numpy().tobytes() for tensor in (motion.rotations, motion.translations)
    ]
    return _digest(b"".join([repr(motion.fps).encode(), *values]))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
