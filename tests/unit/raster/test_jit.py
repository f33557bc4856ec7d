"""How kernels are compiled."""

import numpy as np
from numba import njit

from dsar.raster import jit


def _sums(values, out):
    """Do what no compiler inlines of itself at two places."""
    for row in range(len(values)):
        total = np.float32(0)
        for column in range(values.shape[1]):
            total += values[row, column] * np.sqrt(values[column, row] + values[row, row])
        out[row] += total
        for column in range(values.shape[1]):
            out[row] -= values[row, column] / (out[column] * out[column] + np.float32(1))


def _calls(part):
    """Return how often the code of a kernel mentions a part that it has at two places."""

    def run(values, out):
        part(values, out)
        part(values, out)

    compiled = njit(**jit._OPTIONS)(run)
    compiled(np.ones((4, 4), np.float32), np.zeros(4, np.float32))
    lines = next(iter(compiled.inspect_llvm().values())).splitlines()
    return sum("call" in line and "_sums" in line for line in lines)


def test_parts_of_kernels_are_in_their_code_and_no_functions_that_two_processes_optimise_differently():
    assert _calls(njit(**jit._OPTIONS)(_sums)) > 0
    assert _calls(jit.inlined(_sums)) == 0
