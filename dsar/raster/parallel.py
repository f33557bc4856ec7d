"""Kernels spread over threads: the same result for any number, because a part writes only what is its own.

Python threads around kernels that release the GIL, rather than Numba's own: those would compile every kernel
twice, spin while other processes want the core, and abort in a process forked after the first call.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numba

_MAX_PARTS = 16
"""More threads than this wait for each other longer than an image takes."""


def part_count() -> int:
    """Return how many parts the next kernel is run in."""
    return min(numba.get_num_threads(), _MAX_PARTS)


def run_parts(kernel: Callable[..., None], *arguments: object) -> None:
    """Run kernel(part, parts, *arguments) for every part, one per thread (`numba.get_num_threads`)."""
    parts = part_count()
    others = [_pool(os.getpid(), parts).submit(kernel, part, parts, *arguments) for part in range(1, parts)]
    kernel(0, parts, *arguments)
    for other in others:
        other.result()


@cache
def _pool(process: int, parts: int) -> ThreadPoolExecutor:
    """Return this process's threads; a forked child does not inherit its parent's."""
    return ThreadPoolExecutor(parts - 1, thread_name_prefix="raster")
