"""What sequences of splat files share: names, atomic writing, and a manifest beside them."""

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from dsar.atomic_files import atomic_write
from dsar.types import Gaussians, GaussianSequence
from dsar_exporters.checks import check_file_name
from dsar_exporters.delivery import Sink
from dsar_exporters.manifest import write_manifest

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SplatSequence(ABC):
    """One file a frame in a folder, `<name>.<frame, 4 digits><suffix>`, and a manifest beside the folder.

    Each file appears when it is complete; those of earlier frames stay if a later frame fails.
    """

    folder: Path
    """Where the files go; made if missing."""
    name: str
    """First part of the file names."""
    _written: list[Path] = field(default_factory=list, repr=False, compare=False)

    suffix: ClassVar[str]
    """Ends the file names, with its dot."""

    @property
    def path(self) -> Path:
        """The folder."""
        return self.folder

    def frame_path(self, frame: int) -> Path:
        """Return the file of a frame."""
        return self.folder / f"{self.name}.{frame:04d}{self.suffix}"

    @contextmanager
    def open_sink(self, sequence: GaussianSequence) -> Iterator[Sink]:
        """Take frames; see `Output`.

        Raises:
            ExportError: The name cannot be part of a file name, or the folder cannot be made.
            MissingDependencyError: The format's library is not installed.
        """
        check_file_name("file name", self.name)
        self.check()
        self.folder.mkdir(parents=True, exist_ok=True)
        self._warn_of_others(sequence)
        self._written.clear()

        def write(frame: int, gaussians: Gaussians) -> None:
            path = self.frame_path(frame)
            with atomic_write(path) as draft:
                self.write_frame(draft, gaussians, sequence, frame)
            self._written.append(path)

        yield write
        self._written.append(write_manifest(self.folder, sequence, self._written))

    def written_files(self) -> Sequence[Path]:
        """Return the files of the last pass."""
        return list(self._written)

    def _warn_of_others(self, sequence: GaussianSequence) -> None:
        """Players take a whole folder: say what else of that name it holds."""
        ours = {self.frame_path(frame) for frame in sequence.frame_numbers}
        others = set(self.folder.glob(f"{self.name}.*{self.suffix}")) - ours
        if others:
            _logger.warning(
                "%s already holds %d files of other frames, such as %s; players that take a whole folder "
                "will show them too",
                *(self.folder, len(others), min(others).name),
            )

    @abstractmethod
    def check(self) -> None:
        """Raise where the options or the format's library are not as they must be."""

    @abstractmethod
    def write_frame(self, draft: Path, gaussians: Gaussians, sequence: GaussianSequence, frame: int) -> None:
        """Write one frame to a path without a suffix."""

    @abstractmethod
    def estimated_bytes(self, first: Gaussians, frames: int) -> int:
        """Return how large the files will be; see `Output`."""
