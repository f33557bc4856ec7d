"""Animated USD assets of Gaussian avatars."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from dsar.geometry.camera_paths import CameraPath
from dsar.types import Camera, GaussianSequence
from dsar_exporters.delivery import export
from dsar_exporters.optional import require
from dsar_exporters.usd.output import UsdAsset

__all__ = ["UsdAsset", "list_usd_cameras", "read_usd_cameras", "read_usd_projections", "write_usd"]


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
