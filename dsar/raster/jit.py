"""The two decorators of the kernels: how Numba compiles them."""

import inspect
from collections.abc import Callable
from typing import Any

from numba import njit

_OPTIONS = {
    # Freedom to fuse and reorder, so that loops vectorise. NaN keeps its meaning: culling needs it.
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
    # A division that may raise would stop a loop from vectorising.
    "error_model": "numpy",
}


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a part of a kernel."""
    # Unwrapped: checks that an import hook put around the function are not for the compiler.
    return njit(**_OPTIONS)(inspect.unwrap(function))


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that Python calls: kept on disk once compiled, and able to run beside other threads.

    Numba notices edits of the kernel's own file only, so a kernel calls nothing compiled from another file.
    """
    return njit(cache=True, nogil=True, **_OPTIONS)(inspect.unwrap(function))
