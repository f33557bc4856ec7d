"""Where the CPU rasteriser's time goes: each kernel's milliseconds, and how busy blending keeps the cores."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from scene import make_image_gradient

from dsar.raster import cpu, rasterize
from dsar.raster.simd import LANES
from dsar.types import Camera, Gaussians

FLOP_PER_LANE = {"composite_part": 36, "composite_backward_part": 62}
"""Floating-point operations on each lane of a block that a splat visits, counted in the kernels' source: a
fused multiply-add is two, a comparison one, what works on bits none."""


@dataclass(frozen=True)
class KernelTimes:
    """One scene's forward and backward pass, taken apart."""

    median_ms: dict[str, float]
    """By kernel, in the order they run."""
    lanes: int
    """Pixels of the blocks that splats visit, hidden ones included: what blending has to compute at most."""
    gflops: dict[str, float]
    """By blending kernel. Blocks that are finished are skipped, so the true rate is a little lower."""


def measure_kernels(gaussians: Gaussians, camera: Camera, repeats: int) -> KernelTimes:
    """Time every kernel of a forward and backward pass, with as many threads as numba is set to."""
    leaves = gaussians.map(lambda values: values.detach().clone().requires_grad_())
    v_color = make_image_gradient(camera)
    seconds, arguments = defaultdict(list), {}
    with _timed(seconds, arguments):
        for _ in range(repeats + 1):
            color = rasterize(leaves, camera, backend="cpu").color
            torch.autograd.grad(color, [leaves.means], v_color)
    medians = {name: 1e3 * float(np.median(durations[1:])) for name, durations in seconds.items()}
    # Kernel, records, tile_offsets, pairs, ...
    blocks = arguments["composite_part"][3][:, 1].copy().view(np.uint8)
    lanes = int(np.unpackbits(blocks).sum()) * LANES
    gflops = {name: 1e-6 * lanes * flop / medians[name] for name, flop in FLOP_PER_LANE.items()}
    return KernelTimes(medians, lanes, gflops)


@contextmanager
def _timed(seconds: dict[str, list[float]], arguments: dict[str, tuple]) -> Iterator[None]:
    """Have every kernel of the rasteriser timed and its last arguments kept."""

    def watch(name, function):
        def watched(*kernel_arguments):
            start = time.perf_counter()
            result = function(*kernel_arguments)
            seconds[name].append(time.perf_counter() - start)
            arguments[name] = kernel_arguments
            return result

        return watched

    plain = {name: getattr(cpu, name) for name in ("run_parts", "sort_by_depth", "prefix_sum")}
    try:
        cpu.run_parts = lambda kernel, *kernel_arguments: watch(kernel.__name__, plain["run_parts"])(
            kernel, *kernel_arguments
        )
        for name in ("sort_by_depth", "prefix_sum"):
            setattr(cpu, name, watch(name, plain[name]))
        yield
    finally:
        for name, function in plain.items():
            setattr(cpu, name, function)
