"""The two decorators of the kernels: how Numba compiles them."""

import inspect
import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit

_logger = logging.getLogger(__name__)

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
    """Compile a part of a kernel, which becomes part of its code wherever it is called.

    Left as functions, parts are shared within a process: a kernel that was compiled in it calls those that
    were optimised by themselves, the same kernel loaded from the disk those that were optimised with it. The
    two round differently, and the first process on a machine would not repeat.
    """
    # Unwrapped: checks that an import hook put around the function are not for the compiler.
    return njit(forceinline=True, **_OPTIONS)(inspect.unwrap(function))


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that Python calls: kept on disk once compiled, and able to run beside other threads.

    Numba itself notices edits of the kernel's own file only; what kernels share is watched here. Where no
    disk keeps it, the kernel is compiled anew in every process.
    """
    plain = inspect.unwrap(function)
    try:
        dispatcher = njit(cache=True, nogil=True, **_OPTIONS)(plain)
    except RuntimeError as error:  # neither the package's folder nor the user's takes files
        _warn_not_cached(str(error))
        return njit(nogil=True, **_OPTIONS)(plain)
    disk_cache: Any = dispatcher._cache  # pyright: ignore[reportAttributeAccessIssue]  # no public way
    disk_cache._cache_file._source_stamp = disk_cache._cache_file._source_stamp, _SHARED
    save = disk_cache.save_overload

    def save_if_there_is_room(*compiled: Any) -> None:
        try:
            save(*compiled)
        except OSError as error:
            _warn_not_cached(str(error))

    disk_cache.save_overload = save_if_there_is_room
    return dispatcher


@cache
def _warn_not_cached(reason: str) -> None:
    """Say once that compiled kernels are not kept."""
    _logger.warning(
        "The rasteriser's compiled kernels cannot be kept, and are compiled every time (about 30 s): %s; "
        "NUMBA_CACHE_DIR names a folder that takes them",
        reason,
    )
