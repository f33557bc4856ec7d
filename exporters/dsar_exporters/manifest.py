"""The sidecar of an export: what the files are, for people and pipelines that cannot open them."""

import importlib.metadata
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fileseq.frameset import FrameSet

from dsar.atomic_files import atomic_write
from dsar.types import GaussianSequence

_PACKAGES = ("dsar-avatar", "torch", "usd-core", "plyfile", "gsply", "fourdgs")


def manifest_path(path: Path) -> Path:
    """Return the manifest of a file or folder: `<name>.manifest.json` beside it."""
    # The working folder has a name, too.
    path = path.absolute()
    return path.with_name(f"{path.name}.manifest.json")


def write_manifest(
    path: Path, sequence: GaussianSequence, files: Sequence[Path], facts: Mapping[str, Any]
) -> Path:
    """Write the manifest of a file or folder and return its path.

    Args:
        path: The file or folder; a manifest that is there is replaced.
        sequence: What was written.
        files: Its files; the manifest names them as seen from its own folder.
        facts: What is true of this format only, such as its axes and colour space.
    """
    numbers = list(sequence.frame_numbers)
    content = {
        "frames": {
            "range": str(FrameSet(numbers)),
            "count": len(numbers),
            "first": numbers[0],
            "last": numbers[-1],
            "fps": sequence.fps,
        },
        "gaussians": sequence.num_gaussians,
        "ids": "index 0 to gaussians - 1: the same Gaussian in every frame and every format that keeps order",
        "units": "metres",
        **facts,
        "provenance": dict(sequence.provenance),
        "versions": _versions(),
        "files": [file.absolute().relative_to(path.absolute().parent).as_posix() for file in files],
    }
    target = manifest_path(path)
    with atomic_write(target) as draft:
        draft.write_text(json.dumps(content, indent=2) + "\n")
    return target


def _versions() -> dict[str, str]:
    """Return the versions of the packages that had a hand in it, those that are installed."""
    found = {}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
