"""How long a function takes: medians with their spread, on a machine that others use too."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

LEAST_RUNS = 3


@dataclass(frozen=True)
class Timing:
    """What several runs of one function took, in milliseconds."""

    median_ms: float
    low_ms: float
    """First quartile."""
    high_ms: float
    """Third quartile."""
    runs: int


def time_once(function: Callable[[], object]) -> float:
    """Return the seconds of one run."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def time_runs(function: Callable[[], object], seconds: float, most: int) -> Timing:
    """Run a function until `seconds` or `most` runs are over, but at least LEAST_RUNS times."""
    times = []
    while len(times) < LEAST_RUNS or (sum(times) < seconds and len(times) < most):
        times.append(time_once(function))
    low, median, high = 1e3 * np.percentile(times, [25, 50, 75])
    return Timing(float(median), float(low), float(high), len(times))
