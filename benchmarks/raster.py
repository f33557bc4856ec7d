"""How fast the CPU rasteriser is, against the plain torch one in the same run.

    python benchmarks/raster.py [--quick] [--json FILE]

A body-like shell of Gaussians, forward and forward + backward by every field, projection and colour
included. Best of several runs, on as many threads as NUMBA_NUM_THREADS and OMP_NUM_THREADS allow.
"""

import argparse
import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numba
import numpy as np
import torch

from dsar.geometry.cameras import look_at
from dsar.raster import rasterize
from dsar.types import Camera, Gaussians

# Gaussians, width, height.
SIZES = ((10_000, 96, 128), (10_000, 192, 256), (20_000, 256, 256), (50_000, 320, 448))
# The reference takes up to a hundred times as long, and runs on these only.
REFERENCE_SIZES = ((10_000, 96, 128), (20_000, 256, 256))


def make_body(count: int) -> Gaussians:
    """Return flat Gaussians on a standing capsule, 70 % nearly opaque, as large as covers it."""
    generator = torch.Generator().manual_seed(0)
    angle, height, kind = torch.rand(3, count, generator=generator)
    angle, height = 2 * math.pi * angle, 1.8 * height
    radius = 0.25 + 0.05 * torch.sin(3 * height)
    spacing = (2 * math.pi * 0.25 * 1.8 / count) ** 0.5
    scales = 0.75 * spacing * (0.6 + 0.8 * torch.rand(count, 3, generator=generator))
    return Gaussians(
        torch.stack([radius * angle.cos(), height, radius * angle.sin()], -1),
        torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1),
        scales * torch.tensor([0.2, 1.0, 1.0]),
        torch.where(kind < 0.7, 0.95, 0.4),
        torch.randn(count, 1, 3, generator=generator) * 0.5,
    ).map(torch.Tensor.requires_grad_)


def make_camera(width: int, height: int) -> Camera:
    """Return a camera 3 m away whose image the body fills to 85 % of its height."""
    focal = 0.85 * height / 1.8 * 3
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(K, look_at(np.array([0.0, 1.0, 3.0]), np.array([0.0, 0.9, 0.0])), width, height, "front")


def time_ms(function: Callable[[], object], repeats: int) -> float:
    """Return the shortest of several runs, after one that does not count."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def measure(
    backend: Literal["reference", "cpu"], size: tuple[int, int, int], repeats: int
) -> dict[str, float]:
    """Return the milliseconds of a forward and of a forward and backward pass."""
    gaussians, camera = make_body(size[0]), make_camera(*size[1:])
    leaves = [getattr(gaussians, name) for name in vars(gaussians)]
    v_color = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1))

    def forward() -> torch.Tensor:
        return rasterize(gaussians, camera, backend=backend).color

    def forward_backward() -> None:
        torch.autograd.grad(forward(), leaves, v_color)

    with torch.no_grad():
        forward_ms = time_ms(forward, repeats)
    return {"forward_ms": forward_ms, "forward_backward_ms": time_ms(forward_backward, repeats)}


def main() -> None:
    """Measure, print, and write what was found."""
    parser = argparse.ArgumentParser(description="Time the CPU rasteriser against the plain torch one.")
    parser.add_argument("--quick", action="store_true", help="under a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    arguments = parser.parse_args()
    repeats = 10 if arguments.quick else 50
    rows = []
    for size in SIZES[:3] if arguments.quick else SIZES:
        rows.append({"backend": "cpu", "size": size} | measure("cpu", size, repeats))
        print(describe(rows[-1]))
    fast = {row["size"]: row["forward_backward_ms"] for row in rows}
    ratios = {}
    for size in REFERENCE_SIZES[:1] if arguments.quick else REFERENCE_SIZES:
        rows.append({"backend": "reference", "size": size} | measure("reference", size, 2))
        ratios["{} at {} x {}".format(*size)] = rows[-1]["forward_backward_ms"] / fast[size]
        print(describe(rows[-1]))
    found = {"threads": numba.get_num_threads(), "torch": torch.__version__, "numba": numba.__version__}
    found |= {"rows": rows, "ratios": ratios}
    if arguments.json:
        temporary = arguments.json.with_suffix(".tmp")
        temporary.write_text(json.dumps(found, indent=2))
        os.replace(temporary, arguments.json)
    for size, ratio in ratios.items():
        print(f"cpu is {ratio:.0f}x as fast as reference, forward + backward of {size}")


def describe(row: dict) -> str:
    """Return one line of the table."""
    count, width, height = row["size"]
    return (
        f"{row['backend']:9} {count:6} Gaussians at {width:3} x {height:3}: "
        f"forward {row['forward_ms']:8.2f} ms, forward + backward {row['forward_backward_ms']:8.2f} ms"
    )


if __name__ == "__main__":
    main()
