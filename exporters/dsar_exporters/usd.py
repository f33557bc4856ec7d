"""Animated USD assets of Gaussian avatars."""

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

from dsar.errors import ExportError, MissingDependencyError
from dsar.types import Camera, GaussianSequence
from dsar_exporters.checks import check_cameras, check_name, check_sequence
from dsar_exporters.optional import require

_SUFFIXES = (".usda", ".usdc", ".usd")


def write_usd(sequence: GaussianSequence, path: Path, *, name: str, cameras: Sequence[Camera] = ()) -> Path:
    """Write an animated asset and return its path.

    The asset `/<name>` holds the same Gaussians twice, and a variant set `representation` shows one of them:
    `instancer` (the default: a PointInstancer of ellipsoids, which every USD application draws) or `splats`
    (a ParticleField3DGaussianSplat with spherical harmonics). Cameras lie under `/<name>/cameras`. Metres,
    Y up; time codes are frame numbers. Values that never change are written once.

    A `.usda` is a small readable root whose data lie in `<stem>.payload.usdc` beside it; `.usdc` and `.usd`
    are one binary file. The files are written and validated under temporary names in the same folder and
    then renamed, so that a failed export leaves an earlier one as it was.

    Args:
        sequence: The frames, produced once and one at a time.
        path: A `.usda`, `.usdc` or `.usd`; folders are made if missing.
        name: Name of the asset's root prim.
        cameras: The rig, static.

    Raises:
        ExportError: A name, the suffix or the sequence is not fit for export, or the file fails validation.
        MissingDependencyError: usd-core is not installed, or is older than 26.3.
    """
    if path.suffix not in _SUFFIXES:
        raise ExportError(f"{path}: expected a name ending in {', '.join(_SUFFIXES)}: rename the output")
    check_name("USD name", name)
    check_cameras(cameras)
    check_sequence(sequence)
    volumes = require("pxr.UsdVol", feature="USD", package="usd-core>=26.3", extra="usd")
    if not hasattr(volumes, "ParticleField3DGaussianSplat"):
        raise MissingDependencyError("USD", "usd-core>=26.3", "usd")
    # These modules import pxr when they are loaded, which must not happen before it is asked for.
    from dsar_exporters.usd_stage import author_asset
    from dsar_exporters.usd_validation import validate_asset

    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        drafts = author_asset(sequence, Path(folder) / path.name, name=name, cameras=cameras)
        validate_asset(drafts[-1], sequence, name=name)
        for draft in drafts:
            os.replace(draft, path.parent / draft.name)
    return path
