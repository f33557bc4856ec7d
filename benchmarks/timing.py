"""How long a function takes: medians with their spread, on a machine that others use too."""

import time
from collections.abc import Callable, Sequence
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
    return time_together([function], seconds, most)[0]


def time_together(functions: Sequence[Callable[[], object]], seconds: float, most: int) -> list[Timing]:
    """Run functions in turn, so that all meet the same machine, until `seconds` or `most` rounds are over."""
    rounds: list[list[float]] = []
    while len(rounds) < LEAST_RUNS or (sum(map(sum, rounds)) < seconds and len(rounds) < most):
        rounds.append([time_once(function) for function in functions])
    quartiles = 1e3 * np.percentile(rounds, [25, 50, 75], axis=0)
    return [Timing(*map(float, times), len(rounds)) for times in quartiles[[1, 0, 2]].T]
