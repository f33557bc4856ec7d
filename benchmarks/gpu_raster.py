"""The GPU benchmark's rasterisers: how far from the float64 reference, and how fast."""

import dataclasses
import importlib
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import torch
from gpu_memory import forget_peak, read_peak
from scene import make_body, make_camera, make_image_gradient
from timing import time_together

from dsar.devices import choose_device
from dsar.evaluation.profiling import read_clock
from dsar.raster import Backend, rasterize, rasterize_views
from dsar.types import Camera, Gaussians, RenderOutput

SAME_VALUE = 1e-4
"""Largest difference of an image's value from the reference's; a pixel in 500 may lie at a cut-off."""
MOST_APART = 0.002
SAME_GRADIENT = 1e-3
"""Largest difference of a field's gradient, as a share of its norm."""
MOST_RUNS = 200
PACKED_KERNELS = Path(__file__).parents[1] / "kernels"
"""Where tools/pack_gpu_benchmark.py puts Warp's kernels."""
PASSES = ("forward", "forward_backward")


@dataclass(frozen=True)
class RasterPlan:
    """What is drawn."""

    parity: tuple[int, int, int]
    """Gaussians, width and height of the scenes that are held against the reference."""
    sizes: tuple[tuple[int, int, int], ...]
    """The same of those that are timed."""
    batch: tuple[int, int, int, int]
    """Sets of Gaussians of a batch, each of so many, and width and height of its one view."""
    seconds: float
    """Time for each measurement, by backend."""


FULL = RasterPlan(
    parity=(2_000, 96, 128),
    sizes=((20_000, 256, 256), (200_000, 256, 256), (20_000, 940, 1280), (200_000, 940, 1280)),
    batch=(32, 20_000, 256, 256),
    seconds=1.5,
)
QUICK = RasterPlan(parity=(60, 24, 32), sizes=((500, 48, 64),), batch=(2, 100, 24, 32), seconds=0.02)
NEEDS: dict[str, tuple[str, str]] = {"warp": ("warp", "gpu"), "gsplat": ("gsplat", "gsplat")}
"""The module of an optional backend, and the extra that brings it."""


def measure_parity(quick: bool, device: str, backends: Sequence[Backend] | None = None) -> Iterator[dict]:
    """Yield how far each backend is from the reference, by scene."""
    where, plan = choose_device(device), QUICK if quick else FULL
    yield {"kernels": "packed" if load_kernels(where) else "compiled here", "skipped": None}
    for name, (gaussians, camera, options) in make_scenes(*plan.parity).items():
        slow = render_with_gradients(gaussians, camera, "reference", torch.device("cpu"), options)
        for backend in backends or backends_of(where):
            row = {"scene": name, "backend": backend, "skipped": find_obstacle(backend)}
            if row["skipped"] is None:
                fast = render_with_gradients(gaussians, camera, backend, where, options)
                row |= compare(fast, slow)
            yield row


def backends_of(device: torch.device) -> tuple[Backend, ...]:
    """Return the backends for a device that need no compiler."""
    return ("warp", "reference") if device.type == "cuda" else ("cpu", "warp")


def load_kernels(device: torch.device) -> bool:
    """Have Warp take the kernels that travelled as PTX, if any did, which saves compiling them."""
    folders = sorted(PACKED_KERNELS.glob("*")) if device.type == "cuda" else []
    if not folders or find_obstacle("warp"):
        return False
    import warp as wp

    for folder in folders:
        module = importlib.import_module(f"dsar.raster.warp_backend.kernels_{folder.name}")
        try:
            wp.load_aot_module(module, device=wp.device_from_torch(device), module_dir=folder, use_ptx=True)
        except FileNotFoundError:
            # They are for another architecture; Warp compiles its own.
            return False
    return True


def find_obstacle(backend: Backend) -> str | None:
    """Return why a backend cannot draw, None where it can."""
    if backend not in NEEDS or importlib.util.find_spec(NEEDS[backend][0]):
        return None
    return f"not installed: pip install 'dsar-avatar[{NEEDS[backend][1]}]'"


def make_scenes(count: int, width: int, height: int) -> dict[str, tuple[Gaussians, Camera, dict]]:
    """Return Gaussians, camera and options of the scenes of the comparison, by name."""
    body, camera = make_body(count), make_camera(width, height)
    generator = torch.Generator().manual_seed(2)
    colored = dataclasses.replace(body, harmonics=0.3 * torch.randn(count, 9, 3, generator=generator))
    large = camera.resized(4 * width, 4 * height).cropped(width, height, width, height)
    reduced = {"dilation": 0.1375, "antialiased": True}
    return {
        "whole": (body, camera, {}),
        "nine harmonics, reduced": (colored, camera, reduced),
        "crop of a larger view": (colored, large, {}),
    }


def render_with_gradients(
    gaussians: Gaussians, camera: Camera, backend: Backend, device: torch.device, options: dict
) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Return images, and gradients of a fixed random weighting of them; the reference's in float64."""
    dtype = torch.float64 if backend == "reference" and device.type == "cpu" else torch.float32
    leaves = gaussians.map(lambda values: values.to(device, dtype).requires_grad_())
    background = torch.tensor([0.2, 0.5, 0.9], dtype=dtype, device=device, requires_grad=True)
    output = rasterize(leaves, camera, background=background, backend=backend, **options)
    images = {name: getattr(output, name) for name in ("color", "alpha", "depth")}
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(image.shape, generator=generator).to(image) for image in images.values()]
    loss = sum((image * weight).sum() for image, weight in zip(images.values(), weights, strict=True))
    inputs = dict(vars(leaves)) | {"background": background}
    gradients = torch.autograd.grad(loss, list(inputs.values()))
    named = dict(zip(inputs, gradients, strict=True))
    return tuple({k: v.detach().cpu().double() for k, v in part.items()} for part in (images, named))


def compare(fast: tuple[dict, dict], slow: tuple[dict, dict]) -> dict:
    """Return differences by image and by field, and whether they are within what tests allow."""
    errors = {name: (fast[0][name] - image).abs() for name, image in slow[0].items()}
    apart = {name: float((~(error <= SAME_VALUE)).double().mean()) for name, error in errors.items()}
    gradients = {
        name: float((fast[1][name] - gradient).norm() / gradient.norm().clamp_min(1e-12))
        for name, gradient in slow[1].items()
    }
    agrees = max(apart.values()) <= MOST_APART and max(gradients.values()) <= SAME_GRADIENT
    median = {name: float(error.median()) for name, error in errors.items()}
    largest = {name: float(error.max()) for name, error in errors.items()}
    values = {"median": median, "largest": largest, "share_apart": apart, "gradients": gradients}
    return values | {"agrees": agrees}


def measure_raster(quick: bool, device: str, backends: Sequence[Backend] | None = None) -> Iterator[dict]:
    """Yield times by size, pass and backend, those of one size and pass taken in turn; then of batches."""
    where, plan = choose_device(device), QUICK if quick else FULL
    load_kernels(where)
    chosen = backends or tuple(name for name in backends_of(where) if name != "reference")
    for backend in chosen:
        if obstacle := find_obstacle(backend):
            yield {"backend": backend, "skipped": obstacle}
    usable = [backend for backend in chosen if find_obstacle(backend) is None]
    for count, width, height in plan.sizes:
        gaussians, camera = (
            make_body(count).map(partial(torch.Tensor.to, device=where)),
            make_camera(width, height),
        )
        gradient = make_image_gradient(camera).to(where)
        same = {"gaussians": count, "width": width, "height": height, "views": 1, "skipped": None}
        for name in PASSES:
            works = [partial(_draw, [gaussians], [camera], [gradient], b, name, at_once=True) for b in usable]
            yield from _time_all(works, [{**same, "backend": b, "pass": name} for b in usable], plan)
    sets, count, width, height = plan.batch
    group = [make_body(count).map(partial(torch.Tensor.to, device=where)) for _ in range(sets)]
    camera = make_camera(width, height)
    gradient = make_image_gradient(camera).to(where)
    same = {"gaussians": count, "width": width, "height": height, "views": sets, "skipped": None}
    for name in PASSES:
        cases = [(b, at_once) for b in usable for at_once in (True, False)]
        works = [
            partial(_draw, group, [camera] * sets, [gradient] * sets, b, name, at_once=at_once)
            for b, at_once in cases
        ]
        yield from _time_all(
            works, [{**same, "backend": b, "pass": name, "at_once": at_once} for b, at_once in cases], plan
        )


def _draw(
    sets: Sequence[Gaussians],
    cameras: Sequence[Camera],
    gradients: Sequence[torch.Tensor],
    backend: Backend,
    name: str,
    *,
    at_once: bool,
) -> None:
    """Draw one view of each set, and back-propagate if the pass says so."""
    backward = name == "forward_backward"
    leaves = [group.map(lambda v: v.detach().requires_grad_(backward)) for group in sets]
    if at_once:
        views = rasterize_views(leaves, [[camera] for camera in cameras], backend=backend)
        outputs: list[RenderOutput] = [output for row in views for output in row]
    else:
        pairs = zip(leaves, cameras, strict=True)
        outputs = [rasterize(group, camera, backend=backend) for group, camera in pairs]
    if backward:
        torch.autograd.backward([output.color for output in outputs], list(gradients))


def _time_all(works: list[Callable[[], None]], rows: list[dict], plan: RasterPlan) -> Iterator[dict]:
    """Yield the rows with times and the memory that one run needs at most."""
    for work, row in zip(works, rows, strict=True):
        forget_peak()
        _finish(work)
        row |= {"peak_bytes": read_peak()}
    timings = time_together([partial(_finish, work) for work in works], plan.seconds * len(works), MOST_RUNS)
    for row, timing in zip(rows, timings, strict=True):
        yield row | asdict(timing)


def _finish(work: Callable[[], None]) -> None:
    """Run, and wait for the GPU."""
    work()
    read_clock()


def measure_gsplat(quick: bool, device: str) -> Iterator[dict]:
    """Yield parity and times of gsplat, Warp beside it; its first image compiles it for minutes."""
    if choose_device(device).type != "cuda":
        yield {"backend": "gsplat", "skipped": "gsplat draws on a CUDA device"}
        return
    if obstacle := find_obstacle("gsplat"):
        yield {"backend": "gsplat", "skipped": obstacle}
        return
    start = read_clock()
    yield from ({"kind": "parity", **row} for row in measure_parity(quick, device, ["gsplat"]))
    yield {"kind": "first image", "backend": "gsplat", "skipped": None, "seconds": read_clock() - start}
    yield from ({"kind": "time", **row} for row in measure_raster(quick, device, ["warp", "gsplat"]))
