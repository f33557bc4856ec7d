"""What all commands share."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dsar.console import ProgressStyle, follow
from dsar.errors import ConfigError
from dsar.types import GaussianSequence

if TYPE_CHECKING:
    from dsar.data.multiview import MultiViewCapture
    from dsar.training.scene import Scene

Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class Common:
    """Flags of every command."""

    device: Device = "auto"
    """Where to compute."""
    seed: int = 0
    """Seed of everything random."""
    progress: ProgressStyle = "auto"
    """How to show progress."""
    json: Path | None = None
    """Write what the command found here, machine-readable."""

    def check_device(self) -> None:
        """Raise ConfigError where the device is not supported."""
        if self.device == "cuda":
            raise ConfigError("--device cuda: this version computes on the CPU only; leave --device out")

    def write_json(self, content: dict) -> None:
        """Write the --json file, if one was asked for."""
        from dsar.training.checkpoint import write_whole

        if self.json is not None:
            write_whole(self.json, json.dumps(content, indent=2) + "\n")


def shown(sequence: GaussianSequence, style: ProgressStyle, title: str) -> GaussianSequence:
    """Return the same sequence, showing progress as it is produced."""
    return dataclasses.replace(
        sequence, produce=lambda: follow(sequence.produce(), len(sequence), style, title)
    )


def capture_sequence(capture: "MultiViewCapture | Scene", motion: str) -> str | None:
    """Return the sequence that --motion names, None where it names a file.

    A split stands for its sequence furthest from training (labelled fd), else for its first.

    Raises:
        ConfigError: a split has no sequence.
    """
    if motion in capture.motions:
        return motion
    if motion in ("test", "train"):
        names = list(capture.splits.get(motion, ()))
        if not names:
            raise ConfigError(
                f"capture {capture.name} has no {motion} sequence; name one of {', '.join(capture.motions)}"
            )
        return next((name for name in names if name in capture.splits.get("fd", ())), names[0])
    return None
