"""Opening USD stages of anyone, and what USD itself says is wrong with them. Imports pxr."""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pxr import Tf, Usd, UsdUtils

from dsar.errors import ExportError

_TEXT, _CRATE, _PACKAGE = b"#usda", b"PXR-USDC", b"PK"
_KINDS = {_CRATE: ".usdc", _TEXT: ".usda", _PACKAGE: ".usdz"}


def open_stage(path: Path) -> Usd.Stage:
    """Return a stage with all its payloads: our own assets keep cameras that move, and Gaussians, in one.

    Raises:
        ExportError: USD cannot open it.
    """
    try:
        return Usd.Stage.Open(str(path), Usd.Stage.LoadAll)
    except Tf.ErrorException as error:
        raise ExportError(
            f"{path}: expected a USD file, found {_misnamed(path) or _unopened(error)}"
        ) from error


def explain_usd_error(error: Tf.ErrorException) -> str:
    """Return what USD says of an error on one line: of a chain of errors the first is the cause."""
    reasons = [fault.commentary for fault in error.args if hasattr(fault, "commentary")]
    return " ".join((reasons or [str(error)])[0].split())


@contextmanager
def warnings_withheld() -> Iterator[None]:
    """Keep USD's warnings from the terminal, where what they say is told otherwise."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        delegate.TakeUncoalescedDiagnostics()


def _unopened(error: Tf.ErrorException) -> str:
    return f"one that USD cannot open: {explain_usd_error(error)}"


def _misnamed(path: Path) -> str | None:
    """Return what a file is that its name says it is not."""
    with path.open("rb") as file:
        start = file.read(8)
    if not start:
        return "an empty file"
    suffix = path.suffix.lower()
    for mark, right in _KINDS.items():
        if start.startswith(mark) and suffix not in (right, ".usd"):
            return f"a {right} file under a {suffix} file's name: rename it"
    mark = next((mark for mark, right in _KINDS.items() if right == suffix), None)
    return None if mark is None or start.startswith(mark) else f"one that starts with {start[:4]!r}"
