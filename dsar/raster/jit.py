"""The two decorators of the kernels: how Numba compiles them."""

from numba import njit

_FASTMATH = {"contract", "reassoc", "nsz", "arcp"}
"""Freedom to fuse and reorder, so that loops vectorise; NaN and infinity keep their meaning, culling needs them."""

inlined = njit(fastmath=_FASTMATH, error_model="numpy")
"""A part of a kernel. The NumPy error model, because a division that may raise stops a loop from vectorising."""

kernel = njit(cache=True, nogil=True, fastmath=_FASTMATH, error_model="numpy")
"""What Python calls: kept on disk once compiled, and able to run in threads.

Numba notices edits of the kernel's own file only, so a kernel calls nothing compiled from another file.
"""
