"""The two decorators of the kernels: how Numba compiles them."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

_OPTIONS = {
    # Freedom to fuse and reorder, so that loops vectorise. NaN keeps its meaning: culling needs it.
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
    # A division that may raise would stop a loop from vectorising.
    "error_model": "numpy",
}
# Time and size of every file whose constants and functions end up inside kernels.
_SHARED = tuple(
    (path.name, path.stat().st_mtime, path.stat().st_size)
    for path in sorted(Path(__file__).parent.glob("*.py"))
)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a part of a kernel."""
    # Unwrapped: checks that an import hook put around the function are not for the compiler.
    return njit(**_OPTIONS)(inspect.unwrap(function))


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that Python calls: kept on disk once compiled, and able to run beside other threads.

    Numba itself notices edits of the kernel's own file only; what kernels share is watched here.
    """
    dispatcher = njit(cache=True, nogil=True, **_OPTIONS)(inspect.unwrap(function))
    stored = dispatcher._cache._cache_file  # pyright: ignore[reportAttributeAccessIssue]  # no public way
    stored._source_stamp = stored._source_stamp, _SHARED
    return dispatcher
