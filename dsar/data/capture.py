"""One door to captures of every format."""

from pathlib import Path

from dsar.data.native import RECORD_NAME, NativeCapture, open_native
from dsar.errors import CaptureError

EMBEDDED_CAPTURE = Path(__file__).parent / "embedded"
"""The simulated capture that comes with the package."""


def open_capture(source: str | Path = "embedded") -> NativeCapture:
    """Return a capture, checked for completeness.

    Args:
        source: A capture folder, or `embedded` for the one that comes with the package.

    Raises:
        CaptureError: The folder is no capture, or something in it is missing or malformed.
    """
    root = EMBEDDED_CAPTURE if source == "embedded" else Path(source)
    if not root.is_dir():
        raise CaptureError(f"capture {root}: no such folder; give a capture folder or `embedded`")
    if not (root / RECORD_NAME).is_file():
        raise CaptureError(
            f"capture {root}: expected a {RECORD_NAME} (docs/capture-format.md describes it), found none; "
            "give the folder that holds it"
        )
    return open_native(root)
