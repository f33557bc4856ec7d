"""Where the files of an asset lie, as seen from its root layer."""

from pathlib import Path


def payload_path(path: Path) -> Path:
    """Return the file of an asset's data."""
    return path.with_suffix(".payload.usdc")


def clips_folder(path: Path) -> Path:
    """Return the folder of an asset's value clips."""
    return path.with_suffix(".clips")


def clips_manifest(folder: Path) -> Path:
    """Return the file that declares what the value clips of a folder hold."""
    return folder / "manifest.usda"
