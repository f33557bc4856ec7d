"""What all commands share."""

import dataclasses
import json
import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dsar.console import ProgressStyle, track_progress
from dsar.errors import ConfigError
from dsar.types import GaussianSequence

if TYPE_CHECKING:
    import torch

    from dsar.avatar.avatar import Avatar
    from dsar.data.captures.multiview import MultiViewCapture
    from dsar.training.checkpoint import Run
    from dsar.training.scene import Scene


@dataclass(frozen=True)
class Common(ABC):
    """Flags of every command."""

    device: str = "auto"
    """Where to compute: cpu, cuda or cuda:N; auto: a GPU if there is one. Pictures are drawn on the CPU."""
    progress: ProgressStyle = "auto"
    """How to show progress."""
    json: Path | None = None
    """Write what the command found here, machine-readable."""

    @abstractmethod
    def run(self) -> None:
        """Do what the command is for."""

    def output_files(self) -> list[Path]:
        """Return the files that the command writes, by its flags."""
        return []

    def output_folders(self) -> list[Path]:
        """Return the folders into which it writes files of its own."""
        return []

    def describe_remains(self) -> str:
        """Return in words what is left of the work when the command is stopped."""
        return "nothing was written"

    def check_outputs_writable(self) -> None:
        """Check, before any work, that all that is to be written can be.

        Raises:
            StorageError: a place cannot be written to.
        """
        from dsar.atomic_files import check_file_writable, check_folder_writable

        for path in [*self.output_files(), *([] if self.json is None else [self.json])]:
            check_file_writable(path)
        for path in self.output_folders():
            check_folder_writable(path)

    def chosen_device(self) -> "torch.device":
        """Return the device that --device names; a ConfigError where it is not there."""
        from dsar.devices import choose_device

        return choose_device(self.device)

    def write_json(self, content: dict) -> None:
        """Write the --json file, if one was asked for."""
        from dsar.atomic_files import write_text_atomically

        if self.json is not None:
            write_text_atomically(self.json, json.dumps(content, indent=2) + "\n")


@dataclass(frozen=True)
class RunCommand(Common):
    """Flags of commands that open a run."""

    run_folder: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(name="run")] = None
    """Run folder; default: the newest under runs/."""

    def chosen_run(self) -> Path:
        """Return the run folder: the one named, else the newest."""
        from dsar.training.checkpoint import newest_run

        return self.run_folder or newest_run().folder


@dataclass(frozen=True)
class GuardedCommand(RunCommand):
    """Flags of commands that roll a trained avatar out."""

    no_guards: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show what the network says, whatever it is; otherwise frames that would break are replaced, and a
    motion far from training is warned of."""

    def guard(self, run: "Run", avatar: "Avatar", scene: "Callable[[], Scene]") -> None:
        """Give an avatar that was loaded from a run its guards, if they are wanted."""
        from dsar.training.guard_limits import attach_guards

        if not self.no_guards:
            attach_guards(run, avatar, scene)


def file_stem(label: str) -> str:
    """Return a label from a file, such as a capture's name, as the first part of a file's name."""
    return re.sub(r"[^\w-]+", "_", label) or "_"


def with_progress(sequence: GaussianSequence, style: ProgressStyle, title: str) -> GaussianSequence:
    """Return the same sequence, showing progress as it is produced."""
    return dataclasses.replace(
        sequence, produce=lambda: track_progress(sequence.produce(), len(sequence), style, title)
    )


def resolve_sequence(capture: "MultiViewCapture | Scene", motion: str) -> str | None:
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
