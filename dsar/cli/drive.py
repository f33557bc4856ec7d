"""What `dsar export` and `dsar render` share: a trained avatar and the motion that drives it."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dsar.cli.common import OnRun, capture_sequence
from dsar.errors import ConfigError
from dsar.geometry.rates import exact_rate, parse_rate, same_rate
from dsar.types import Camera, GaussianSequence, Motion

if TYPE_CHECKING:
    from dsar.avatar.avatar import Avatar


@dataclass(frozen=True)
class Performance:
    """An avatar, a motion at its rate and at that of the delivery, and where they come from."""

    avatar: "Avatar"
    motion: Motion
    delivered: Motion
    """The same at the rate of the frames that are written."""
    cameras: tuple[Camera, ...]
    """Those of the capture."""
    provenance: dict[str, str]

    def roll_out(self, frames: Sequence[int] | None = None) -> GaussianSequence:
        """Return the Gaussians of some frames, all by default."""
        from dsar.avatar import roll_out

        given = {"delivered": self.delivered, "provenance": self.provenance}
        return roll_out(self.avatar, self.motion, frames=frames, **given)


@dataclass(frozen=True)
class Drive(OnRun):
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

    def wanted_frames(self) -> list[int] | None:
        """Return the frames that are asked for, None for all."""
        from dsar_exporters import parse_frames

        return None if self.frames is None else parse_frames(self.frames)

    def open(self) -> Performance:
        """Return the avatar and its motion."""
        from dsar.avatar.rollout import START_FRAME
        from dsar.data.capture import capture_of
        from dsar.data.motion import read_motion, resample
        from dsar.data.novelty import report_novelty
        from dsar.data.plausibility import judge_motion
        from dsar.training.checkpoint import Run, load_checkpoint

        self.check_device()
        fps = None if self.fps is None else parse_rate(self.fps)
        avatar, config, provenance = load_checkpoint(Run(self.chosen_run()))
        capture = capture_of(config)
        name = capture_sequence(capture, self.motion)
        if name is not None:
            self._refuse_file_flags(name)
            motion = capture.motions[name]
        else:
            rate = None if self.motion_fps is None else parse_rate(self.motion_fps, "--motion-fps")
            motion = read_motion(Path(self.motion), avatar.body, up=self.up, fps=rate)
            judge_motion(avatar.body, motion)
        provenance["motion_hash"] = _hash(motion)
        driven = delivered = motion if same_rate(motion.fps, avatar.fps) else resample(motion, avatar.fps)
        if fps is not None and not same_rate(fps, avatar.fps):
            delivered = resample(motion, fps)
            provenance["fps"] = str(exact_rate(fps))
        if name is None:
            known = [capture.motions[trained] for trained in capture.splits["train"]]
            report_novelty(avatar.body, delivered, known, START_FRAME)
        return Performance(avatar, driven, delivered, tuple(capture.cameras), provenance)

    def _refuse_file_flags(self, sequence: str) -> None:
        """Raise ConfigError where flags for motion files stand beside a sequence of the capture."""
        given = {"--up": self.up, "--motion-fps": self.motion_fps}
        if flags := [flag for flag, value in given.items() if value is not None]:
            raise ConfigError(
                f"{', '.join(flags)}: for motion files; {sequence} is a sequence of the capture, leave out"
            )


def _hash(motion: Motion) -> str:
    """Return a hash of the poses and their rate: a file may change and keep its name."""
    digest = hashlib.sha256(repr(motion.fps).encode())
    for values in (motion.rotations, motion.translations):
        digest.update(values.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]
