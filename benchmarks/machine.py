"""What the benchmark ran on: versions, load, and the arithmetic that the processor can do at most."""

import os
import platform
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numba
import numpy as np
import torch

_WAIT_POLICY = os.environ.get("OMP_WAIT_POLICY", "default")
"""How torch's idle threads wait: what the environment said when torch was imported."""
_ACCUMULATORS = 128
_CHAIN = 4
"""Multiply-adds per accumulator between its load and its store, so that neither limits the rate."""
_FLOP_PER_ROUND = 2 * _ACCUMULATORS * _CHAIN


def describe_machine() -> dict:
    """Return commit, versions, processor and operating system."""
    return {
        "commit": _find_commit(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numba": numba.__version__,
        "numpy": np.__version__,
        "cpu": _find_cpu(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "omp_wait_policy": _WAIT_POLICY,
    }


def read_load() -> list[float] | None:
    """Return the load averages over 1, 5 and 15 minutes, where the system keeps them."""
    return list(os.getloadavg()) if hasattr(os, "getloadavg") else None


def count_memory() -> int | None:
    """Return the machine's main memory in bytes, where the system tells."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else None


def measure_peak(threads: int, repeats: int) -> float:
    """Return the GFLOP/s (a multiply-add is 2) of the fastest of several runs without memory traffic."""
    rounds = 1_000_000
    starts = [np.ones(_ACCUMULATORS, np.float32) for _ in range(threads)]
    _multiply_add(starts[0], 1)
    seconds = []
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(repeats):
            start = time.perf_counter()
            list(pool.map(_multiply_add, starts, [rounds] * threads))
            seconds.append(time.perf_counter() - start)
    return 1e-9 * threads * rounds * _FLOP_PER_ROUND / min(seconds)


@numba.njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def _multiply_add(values, rounds):
    """Multiply and add in place, in as many independent chains as there are values."""
    factor, term = np.float32(0.999), np.float32(0.001)
    for _ in range(rounds):
        for i in range(_ACCUMULATORS):
            value = values[i]
            for _ in range(_CHAIN):
                value = value * factor + term
            values[i] = value


def _find_commit() -> str | None:
    """Return the commit of the source tree, or None outside of one."""
    command = ["git", "rev-parse", "HEAD"]
    try:
        done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def _find_cpu() -> str:
    """Return the processor's name."""
    listing = Path("/proc/cpuinfo")
    if listing.exists():
        for line in listing.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
