"""Animated USD assets of Gaussian avatars."""

import logging
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from dsar.atomic_files import find_quoted_os_error
from dsar.errors import ExportError, MissingDependencyError
from dsar.geometry.camera_paths import TURNTABLE, CameraPath
from dsar.types import Camera, Gaussians, GaussianSequence
from dsar_exporters.checks import check_cameras, check_name
from dsar_exporters.delivery import Sink, export
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


def write_usd(
    sequence: GaussianSequence,
    path: Path,
    *,
    name: str,
    cameras: Sequence[Camera] = (),
    half: bool = False,
    clips: bool = False,
) -> Path:
    """Write an animated asset and return its path.

    The asset `/<name>` holds the same Gaussians twice, and a variant set `representation` shows one of them:
    `instancer` (the default: a PointInstancer of ellipsoids, which every USD application draws) or `splats`
    (a ParticleField3DGaussianSplat with spherical harmonics); `proxy` shows the skinned body mesh instead.
    The body is there in any case, as UsdSkel. A variant set `lod` chooses all Gaussians, half or a quarter of
    them, under the same ids. Cameras lie under `/<name>/cameras`, with one called `turntable`. Metres, Y up;
    time codes are frame numbers. Values that never change are written once. Body, `proxy` and turntable need
    a sequence with a binding.

    A `.usda` is a small readable root whose data lie in `<stem>.payload.usdc` beside it; `.usdc` and `.usd`
    are one binary file. The files are written and validated under temporary names in the same folder and
    then renamed, so that a failed export leaves an earlier one as it was. `<file>.manifest.json` says what
    was written.

    Args:
        sequence: The frames, produced once and one at a time.
        path: A `.usda`, `.usdc` or `.usd`; folders are made if missing.
        name: Name of the asset's root prim.
        cameras: The rig, static.
        half: Write rotations, scales, opacities and harmonics of splats in 16 bits; positions stay in 32,
            because 16 are a millimetre at two metres.
        clips: Write Gaussians to one value clip a frame, in `<stem>.clips/`, for shots of many gigabytes.

    Raises:
        ExportError: A name, the suffix or the sequence is not fit for export, or the file fails validation.
        MissingDependencyError: usd-core is not installed, or is older than 26.3.
    """
    export(sequence, [UsdAsset(path, name, cameras=cameras, half=half, clips=clips)])
    return path


def list_usd_cameras(path: Path) -> list[str]:
    """Return the names by which `read_usd_cameras` calls the cameras of a USD stage, whatever these are.

    Raises:
        ExportError: It is no USD file or has no camera.
        MissingDependencyError: usd-core is not installed.
    """
    require("pxr.UsdGeom", feature="USD", package="usd-core>=26.3", extra="usd")
    from dsar_exporters.usd.camera_reader import list_cameras

    return list_cameras(path)


def read_usd_cameras(
    path: Path,
    *,
    frames: Sequence[int],
    resolution: tuple[int, int] | None = None,
    fps: float | None = None,
    chosen: Collection[str] | None = None,
) -> list[CameraPath]:
    """Read cameras of a USD stage, ours or anyone's, in the stage's order.

    What moves, be it the camera, a parent or the lens, is keyed at the frames and their neighbours; all else
    is at rest. Time codes are frame numbers; where the stage has another rate than these, frame 1001, the
    first, is time code 1001, and what follows and precedes it is taken by seconds. The stage's unit and up
    axis are converted to ours, and scale is taken off. A camera is called as its prim, in files of Blender
    and Maya that give it two as its object, and led by its parent's name where that is not unique.

    Args:
        path: A `.usda`, `.usdc`, `.usd` or `.usdz`; all its payloads are loaded.
        frames: Frame numbers at which the cameras will be asked for, at least one.
        resolution: Width and height of the pictures; without it those that our own files note. Where their
            aspect is, to a hundredth, the aperture's or the note's, the picture shows the aperture; else the
            aperture's width is the picture's and pixels are square, as with `usdrecord`.
        fps: Frames per second of the frame numbers; None: the stage's.
        chosen: Names of the cameras to read; the others may be of a kind that we refuse. None: every one.

    Raises:
        ExportError: It is no USD file or has no camera; one to read has no resolution, is not perspective,
            or is mirrored or sheared.
        MissingDependencyError: usd-core is not installed.
    """
    require("pxr.UsdGeom", feature="USD", package="usd-core>=26.3", extra="usd")
    from dsar_exporters.usd.camera_reader import read_cameras

    return read_cameras(path, frames, resolution, fps, chosen)


def read_usd_projections(
    path: Path, sizes: Mapping[str, tuple[int, int]]
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Return how USD's own frustums map the world to pixels (column vectors, pixels times w), by camera.

    At the stage's first time code; the world in metres, Y up, whatever the stage says that it is in.

    Args:
        path: A USD file.
        sizes: Width and height of the pictures of the cameras that are wanted, by prim name.

    Raises:
        ExportError: A camera is not there.
        MissingDependencyError: usd-core is not installed.
    """
    require("pxr.UsdGeom", feature="USD", package="usd-core>=26.3", extra="usd")
    from dsar_exporters.usd.frustums import project_with_frustums

    return project_with_frustums(path, sizes)


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
    def opened(self, sequence: GaussianSequence) -> Iterator[Sink]:
        """Take frames; see `Output`.

        Raises:
            ExportError: A name or the suffix is not fit, or the file fails validation.
            MissingDependencyError: usd-core is not installed, or is older than 26.3.
        """
        self._check()
        # These modules import pxr when they are loaded, which must not happen before it is asked for.
        from dsar_exporters.usd.asset import AssetWriter
        from dsar_exporters.usd.validation import refuse_faults

        self.path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{self.path.name}.", dir=self.path.parent) as folder:
            draft = Path(folder) / self.path.name
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
            self._put_in_place(files, Path(folder))
            facts = {"up_axis": "Y", "color_space": "srgb_rec709_display", "half": self.half}
            self._written.append(write_manifest(self.path, sequence, self._written, facts))

    def estimated_bytes(self, first: Gaussians, frames: int) -> int:
        """Return how large the files will be where everything changes in every frame; see `Output`."""
        harmonics = 3 * first.harmonics.shape[1]
        floats, halves = (
            (_HALF_FLOATS, _HALF_HALVES + harmonics) if self.half else (_FLOATS + harmonics, _HALVES)
        )
        return round(frames * (_LEVELS * len(first) * (4 * floats + 2 * halves) + _FRAME_BYTES))

    def written(self) -> Sequence[Path]:
        """Return the files of the last pass."""
        return list(self._written)

    def _check(self) -> None:
        if self.path.suffix.lower() not in _SUFFIXES:
            raise ExportError(
                f"{self.path}: expected a name ending in {', '.join(_SUFFIXES)}: rename the output"
            )
        check_name("USD name", self.name)
        self._look_at_clips()
        check_cameras(self.cameras)
        if TURNTABLE in (camera.name for camera in self.cameras):
            raise ExportError(f"camera names: {TURNTABLE} is the name of a camera that we add: rename yours")
        volumes = require("pxr.UsdVol", feature="USD", package="usd-core>=26.3", extra="usd")
        if not hasattr(volumes, "ParticleField3DGaussianSplat"):
            raise MissingDependencyError("USD", "usd-core>=26.3", "usd")

    def _put_in_place(self, files: Sequence[Path], drafts: Path) -> None:
        """Rename finished files, the root layer last, and what they replace into the drafts' folder.

        The old root goes first: in between there is no asset, and never one of old and new files. If a file
        cannot be renamed, all that was replaced comes back.
        """
        targets = {file: self.path.parent / file.name for file in files}
        kept: list[tuple[Path, Path]] = []
        try:
            for index, target in enumerate(reversed(targets.values())):
                if target.exists():
                    kept.append((target, drafts / f"replaced-{index}"))
                    os.replace(*kept[-1])
            for file, target in targets.items():
                os.replace(file, target)
        except OSError:
            for target, old in kept:
                if old.exists():
                    shutil.rmtree(target) if target.is_dir() else target.unlink(missing_ok=True)
                    os.replace(old, target)
            raise
        self._written.clear()
        for target in targets.values():
            self._written.extend(sorted(target.iterdir()) if target.is_dir() else [target])

    def _look_at_clips(self) -> None:
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

    try:
        yield
    except Tf.ErrorException as error:
        # Of a chain of errors the first is the cause; USD quotes its words.
        reasons = [each.commentary.strip() for each in error.args if hasattr(each, "commentary")]
        reason = (reasons or [str(error)])[0]
        raise find_quoted_os_error(reason) or ExportError(
            f"{path}: USD could not write it: {reason}"
        ) from error
