"""EXR parts and the files that hold them: written whole or not at all, and recognised when they are there."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dsar.atomic_files import atomic_write
from dsar.errors import StorageError
from dsar_exporters.exr.completeness import is_complete
from dsar_exporters.exr.openexr import require_openexr


def make_part(header: dict[str, Any], channels: dict[str, Any], name: str, compression: str) -> Any:
    """Return an OpenEXR part of scanlines, compressed as the name of a method says."""
    exr = require_openexr()
    kind = getattr(exr, "NO_COMPRESSION" if compression == "none" else f"{compression.upper()}_COMPRESSION")
    return exr.Part(header | {"type": exr.scanlineimage, "compression": kind}, channels, name=name)


def write_parts(path: Path, parts: Sequence[Any]) -> None:
    """Write a file that appears when it is complete.

    Raises:
        StorageError: The disk does not take it.
    """
    with atomic_write(path) as draft:
        require_openexr().File(list(parts)).write(str(draft))
        if not is_complete(draft):
            raise StorageError(f"{path}: the disk did not take its end: free some room, or write elsewhere")


def holds_views(path: Path, views: Sequence[tuple[str, str]]) -> bool:
    """Return whether a file can be read to its end and says that it shows these cameras for these jobs.

    Args:
        path: The file, which may be missing.
        views: Names of cameras, each with its job's hash.
    """
    if not path.is_file():
        return False
    exr = require_openexr()
    try:
        with exr.File(str(path), header_only=True) as file:
            # Copies: a file empties its headers when it is closed.
            headers = [dict(part.header) for part in file.parts]
        if {(header.get("view"), header.get("dsar/job")) for header in headers} != set(views):
            return False
        with exr.File(str(path)) as file:
            # Parts that cannot be read to their end are left out.
            return len(file.parts) == len(headers)
    except (RuntimeError, ValueError, OSError):
        return False
