"""What is wrong with a delivered file, whoever wrote it."""

from collections.abc import Iterator
from pathlib import Path

import torch

from dsar.errors import ExportError
from dsar.types import Gaussians
from dsar_exporters.optional import require
from dsar_exporters.splats import read_ply, read_splats

_USD = (".usda", ".usdc", ".usd", ".usdz")
_LARGEST = 10.0
"""Metres of a standard deviation above which a splat covers everything: an encoding gone wrong."""


def find_faults(path: Path) -> list[str]:
    """Return what is wrong with a file, one sentence each; nothing where it is sound.

    Args:
        path: A USD asset, a 3DGS `.ply`, a `.compressed.ply` or a `.spz`.

    Raises:
        ExportError: It is none of them, or cannot be opened.
        MissingDependencyError: Its format's library is not installed.
    """
    if not path.is_file():
        raise ExportError(f"{path}: expected a file to check, found none: give its path")
    if path.suffix in _USD:
        require("pxr.UsdVol", feature="USD", package="usd-core>=26.3", extra="usd")
        from dsar_exporters.usd.validation import usd_faults

        return list(usd_faults(path))
    if path.name.endswith(".compressed.ply") or path.suffix == ".spz":
        return list(_splat_faults(read_splats(path)))
    if path.suffix == ".ply":
        return list(_splat_faults(read_ply(path)))
    raise ExportError(f"{path}: expected {', '.join(_USD)}, .ply or .spz, found {path.suffix or 'no suffix'}")


def _splat_faults(gaussians: Gaussians) -> Iterator[str]:
    for name, values in vars(gaussians).items():
        broken = int((~torch.isfinite(values)).sum())
        if broken:
            yield f"expected finite {name}, found {broken} values that are not"
    large = int((gaussians.scales > _LARGEST).any(-1).sum())
    if large:
        yield f"expected standard deviations of metres, found {large} Gaussians above {_LARGEST:g}"
    without = int((gaussians.rotations.norm(dim=-1) < 0.5).sum())
    if without:
        yield f"expected quaternions, found {without} of length 0"
