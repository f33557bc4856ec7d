"""What is wrong with a delivered file, whoever wrote it."""

from pathlib import Path

from dsar.errors import ExportError
from dsar_exporters.optional import require
from dsar_exporters.splats.faults import glb_faults, splat_faults

_USD = (".usda", ".usdc", ".usd", ".usdz")
_SPLATS = (".glb", ".ply", ".spz")


def find_faults(path: Path) -> list[str]:
    """Return what is wrong with a file, one sentence each; nothing where it is sound.

    Args:
        path: A USD asset, a 3DGS `.ply`, plain or compressed, a `.spz` or a `.glb`.

    Raises:
        ExportError: It is none of them, or cannot be opened.
        MissingDependencyError: Its format's library is not installed.
    """
    if not path.is_file():
        kind = "a folder" if path.is_dir() else "none"
        raise ExportError(f"{path}: expected a file to check, found {kind}: give its path")
    suffix = path.suffix.lower()
    if suffix in _USD:
        require("pxr.UsdVol", feature="USD", package="usd-core>=26.3", extra="usd")
        from dsar_exporters.usd.validation import usd_faults

        return list(usd_faults(path))
    if suffix in _SPLATS:
        return list(glb_faults(path) if suffix == ".glb" else splat_faults(path))
    raise ExportError(f"{path}: expected {', '.join((*_USD, *_SPLATS))}, found {path.suffix or 'no suffix'}")
