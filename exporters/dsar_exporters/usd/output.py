"""A USD asset as an output of an export: checked first, written as drafts, validated, then put in place."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from dsar.atomic_files import draft_folder, find_quoted_os_error, replace_together
from dsar.errors import ExportError, MissingDependencyError
from dsar.geometry.camera_paths import TURNTABLE
from dsar.types import Camera, Gaussians, GaussianSequence
from dsar_exporters.checks import check_cameras, check_name
from dsar_exporters.delivery import Sink
from dsar_exporters.manifest import write_manifest
from dsar_exporters.optional import require
from dsar_exporters.usd.names import clips_folder, clips_manifest

_logger = logging.getLogger(__name__)

_SUFFIXES = (".usda", ".usdc", ".usd")
_LEVELS = 1 + 1 / 2 + 1 / 4
"""Gaussians of all levels of detail together, in those of the full one."""
_FLOATS, _HALVES = 3 + 4 + 3 + 3 + 3 + 3 + 1, 4
"""Of a Gaussian and frame without harmonics: positions, orientations, velocities, two scales, colour and
opacity; the instancer's orientations."""
_HALF_FLOATS, _HALF_HALVES = 3 + 3 + 3 + 3 + 1, 4 + 3 + 1
_FRAME_BYTES = 8_000
"""Of a frame beyond its Gaussians: skeleton, camera, extents, tables of times."""


@dataclass(frozen=True)
class UsdAsset:
    """An animated asset; see `write_usd`."""

    path: Path
    """The root layer."""
    name: str
    """Name of the root prim."""
    cameras: Sequence[Camera] = ()
    """The rig."""
    half: bool = False
    """Write splats in 16 bits where that is enough."""
    clips: bool = False
    """One value clip a frame."""
    _written: list[Path] = field(default_factory=list, repr=False, compare=False)

    @contextmanager
    def open_sink(self, sequence: GaussianSequence) -> Iterator[Sink]:
        """Take frames; see `Output`.

        Raises:
            ExportError: A name or the suffix is not fit, or the file fails validation.
            MissingDependencyError: usd-core is not installed, or is older than 26.3.
        """
        self._check()
        # These modules import pxr when they are loaded, which must not happen before it is asked for.
        from dsar_exporters.usd.asset import AssetWriter
        from dsar_exporters.usd.validation import refuse_faults

        with draft_folder(self.path) as folder:
            draft = folder / self.path.name
            with _library_errors(self.path):
                writer = AssetWriter(
                    sequence, draft, name=self.name, cameras=self.cameras, half=self.half, clips=self.clips
                )

            def write(frame: int, gaussians: Gaussians) -> None:
                with _library_errors(self.path):
                    writer.write(frame, gaussians)

            yield write
            with _library_errors(self.path):
                files, frames = writer.files, sequence.frame_numbers
                writer.close()
                del writer
                refuse_faults(draft, sorted({frames[0], frames[len(frames) // 2], frames[-1]}))
            targets = {file: self.path.parent / file.name for file in files}
            replace_together(targets, folder)
            self._written.clear()
            for target in targets.values():
                self._written.extend(sorted(target.iterdir()) if target.is_dir() else [target])
            self._written.append(write_manifest(self.path, sequence, self._written, half=self.half))

    def estimated_bytes(self, first: Gaussians, frames: int) -> int:
        """Return how large the files will be where everything changes in every frame; see `Output`."""
        harmonics = 3 * first.harmonics.shape[1]
        floats, halves = (
            (_HALF_FLOATS, _HALF_HALVES + harmonics) if self.half else (_FLOATS + harmonics, _HALVES)
        )
        return round(frames * (_LEVELS * len(first) * (4 * floats + 2 * halves) + _FRAME_BYTES))

    def written_files(self) -> Sequence[Path]:
        """Return the files of the last pass."""
        return list(self._written)

    def _check(self) -> None:
        if self.path.suffix.lower() not in _SUFFIXES:
            raise ExportError(
                f"{self.path}: expected a name ending in {', '.join(_SUFFIXES)}: rename the output"
            )
        check_name("USD name", self.name)
        self._check_clips()
        check_cameras(self.cameras)
        if TURNTABLE in (camera.name for camera in self.cameras):
            raise ExportError(f"camera names: {TURNTABLE} is the name of a camera that we add: rename yours")
        volumes = require("pxr.UsdVol", feature="USD", package="usd-core>=26.3", extra="usd")
        if not hasattr(volumes, "ParticleField3DGaussianSplat"):
            raise MissingDependencyError("USD", "usd-core>=26.3", "usd")

    def _check_clips(self) -> None:
        """Raise ExportError where the clips' folder is somebody else's; say where it is not used any more."""
        folder = clips_folder(self.path)
        if not folder.exists():
            return
        if not clips_manifest(folder).exists():
            raise ExportError(
                f"{folder}: expected the value clips of an earlier export or nothing, found something else: "
                "rename it or the output"
            )
        if not self.clips:
            _logger.warning("%s: the clips of an earlier export are not used any more", folder)


@contextmanager
def _library_errors(path: Path) -> Iterator[None]:
    """Turn USD's own errors, such as a full disk, into one of ours."""
    from pxr import Tf

    from dsar_exporters.usd.stages import explain_usd_error

    try:
        yield
    except Tf.ErrorException as error:
        # USD quotes the system's words.
        reason = explain_usd_error(error)
        raise find_quoted_os_error(reason) or ExportError(
            f"{path}: USD could not write it: {reason}"
        ) from error
