"""One rollout, any mix of formats: frames are made once and pushed to every output.

Memory does not grow with the length of the sequence: one frame is at hand, and what a format buffers.
"""

import logging
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from dsar.atomic_files import naming_storage_errors
from dsar.errors import DsarError, ExportError
from dsar.types import Gaussians, GaussianSequence
from dsar_exporters.checks import check_sequence, checked_frames

_logger = logging.getLogger(__name__)

Sink = Callable[[int, Gaussians], None]
"""Takes frame numbers, ascending, with their Gaussians: float32 on the CPU."""
_MEGA = 1e6


@runtime_checkable
class Output(Protocol):
    """A format, where its files go, and how they are written."""

    @property
    def path(self) -> Path:
        """The file that stands for what is written, or the folder of a sequence of files."""
        ...

    def open_sink(self, sequence: GaussianSequence) -> AbstractContextManager[Sink]:
        """Check everything that can be checked without a frame, then take frames.

        Leaving without an error puts the files in their place; leaving with one leaves there what was there.
        """
        ...

    def estimated_bytes(self, first: Gaussians, frames: int) -> int:
        """Return how large the files will be, about, from the first frame."""
        ...

    def written_files(self) -> Sequence[Path]:
        """Return the files of the last pass."""
        ...


@dataclass(frozen=True)
class Delivery:
    """What was written of one output."""

    path: Path
    files: int
    size: int
    """Bytes."""
    seconds: float
    """Spent in writing; the rollout's own time is not in it."""


class _TimedSink:
    """An output at work, which knows how long it took."""

    def __init__(self, output: Output) -> None:
        self.output = output
        self.seconds = 0.0

    def open(self, sequence: GaussianSequence) -> AbstractContextManager[Sink]:
        """Open the output and return what closes it."""
        self._closing = self.output.open_sink(sequence)
        self._sink = self._closing.__enter__()
        return self._closing

    def write(self, frame: int, gaussians: Gaussians) -> None:
        """Write a frame."""
        with self._timed(), naming_storage_errors(self.output.path):
            self._sink(frame, gaussians)

    def close(self) -> None:
        """Put the files in their place."""
        with self._timed(), naming_storage_errors(self.output.path):
            self._closing.__exit__(None, None, None)

    @contextmanager
    def _timed(self) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds += time.perf_counter() - start


def export(sequence: GaussianSequence, outputs: Sequence[Output]) -> list[Delivery]:
    """Write every output from one pass over a sequence, and return what was written of each.

    Before anything is written, the log says how large the files will be; after eight frames, how long it will
    take.

    Args:
        sequence: The frames, produced once and one at a time.
        outputs: Formats and places, each place once.

    Raises:
        ExportError: The sequence or an output is not fit. Outputs that could be finished are in their place.
        StorageError: Something cannot be written; likewise.
        MissingDependencyError: A format's library is not installed.
    """
    check_sequence(sequence)
    paths = [output.path.absolute() for output in outputs]
    if doubled := {str(path) for path in paths if paths.count(path) > 1}:
        raise ExportError(f"outputs: expected each place once, found {', '.join(doubled)} twice: rename one")
    sinks: list[_TimedSink] = []
    with ExitStack() as stack:
        for output in outputs:
            sink = _TimedSink(output)
            sinks.append(sink)
            with naming_storage_errors(output.path):
                # Whatever happens before all frames have passed, happens to every output.
                stack.push(sink.open(sequence))
        start = time.perf_counter()
        for done, (frame, gaussians) in enumerate(checked_frames(sequence), start=1):
            if done == 1:
                _announce(outputs, gaussians, len(sequence))
            for sink in sinks:
                sink.write(frame, gaussians)
            if done == _PROBE < len(sequence):
                remaining = (time.perf_counter() - start) / done * (len(sequence) - done)
                _logger.info("About %.0f s left", remaining)
        stack.pop_all()
    return _close(sinks)


def _close(sinks: Sequence["_TimedSink"]) -> list[Delivery]:
    """Put the files of every output in their place, also where another's cannot be."""
    deliveries, errors = [], []
    for sink in sinks:
        try:
            sink.close()
        except DsarError as error:
            errors.append(error)
            continue
        files = sink.output.written_files()
        size = sum(file.stat().st_size for file in files)
        delivery = Delivery(sink.output.path, len(files), size, sink.seconds)
        rate = size / _MEGA / max(delivery.seconds, 1e-9)
        _logger.info(
            "%s: %.1f MB in %d files, %.1f s (%.0f MB/s)",
            *(delivery.path, size / _MEGA, len(files), delivery.seconds, rate),
        )
        deliveries.append(delivery)
    if errors:
        raise errors[0]
    return deliveries


_PROBE = 8
"""Frames after which the time left is known."""


def _announce(outputs: Sequence[Output], first: Gaussians, frames: int) -> None:
    """Say how large each output will be, and where the disk may be too small."""
    needed: dict[int, int] = {}
    for output in outputs:
        size = output.estimated_bytes(first, frames)
        _logger.info("%s: about %.1f MB", output.path, size / _MEGA)
        folder = _existing_folder(output.path)
        device = folder.stat().st_dev
        needed[device] = needed.get(device, 0) + size
        free = shutil.disk_usage(folder).free
        if needed[device] > free:
            # It may fit all the same: values that never change are written once.
            _logger.warning(
                "%s: its disk has %.0f MB free, of about %.0f MB needed: free some, or export fewer frames",
                *(output.path, free / _MEGA, needed[device] / _MEGA),
            )


def _existing_folder(path: Path) -> Path:
    """Return the path, or the nearest one above it, that is a folder."""
    path = path.absolute()
    return next(folder for folder in (path, *path.parents) if folder.is_dir())
