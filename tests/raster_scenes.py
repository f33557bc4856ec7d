"""Gaussians and cameras to rasterise, and how the backends are run and compared."""

import dataclasses
import importlib.util
import math

import pytest
import torch
from torch import Tensor

from dsar.raster import rasterize
from dsar.types import Camera, Gaussians

FIELDS = ("means", "rotations", "scales", "opacities", "harmonics")


def needs(module, package, extra):
    """Skip where a module is not installed."""
    reason = f"{package} is not installed: pip install 'dsar-avatar[{extra}]'"
    return pytest.mark.skipif(importlib.util.find_spec(module) is None, reason=reason)


NEEDS_WARP = needs("warp", "warp-lang", "gpu")
WARP = pytest.param("warp", marks=NEEDS_WARP)
"""On the CPU, where the same kernels run in the same blocks of threads."""
ON_GPU = (
    pytest.param("warp on a GPU", marks=(pytest.mark.gpu, NEEDS_WARP)),
    pytest.param("gsplat", marks=(pytest.mark.gpu, needs("gsplat", "gsplat", "gsplat"))),
)


FAST = ("cpu", WARP, *ON_GPU)


BACKENDS = ("reference", *FAST)


def on(device, record):
    """Return a record of tensors with all of them on a device."""
    if dataclasses.is_dataclass(record):
        fields = {field.name: on(device, getattr(record, field.name)) for field in dataclasses.fields(record)}
        return dataclasses.replace(record, **fields)
    return record.to(device) if isinstance(record, Tensor) else record


def draw(gaussians, camera, backend, background=None, **options):
    """Rasterise where a backend wants its tensors; return the images in main memory."""
    device = "cuda" if backend in ("warp on a GPU", "gsplat") else "cpu"
    background, backend = on(device, background), backend.removesuffix(" on a GPU")
    output = rasterize(on(device, gaussians), camera, background=background, backend=backend, **options)
    return on("cpu", output)


def make_camera(width=53, height=37, focal=60.0, off_center=(4.3, -2.7)):
    """Return a camera at the world's origin that looks along +z, its principal point off the middle."""
    K = torch.tensor(
        [
            [focal, 0.0, width / 2 + off_center[0]],
            [0.0, 1.1 * focal, height / 2 + off_center[1]],
            [0.0, 0.0, 1.0],
        ]
    )
    return Camera(K, torch.eye(4), width, height, "front")


def make_gaussians(count, k=1, seed=0, spread=0.5, size=0.05, opacity=(0.05, 0.95)):
    """Return Gaussians around (0, 0, 1.5), in front of `make_camera`, float64."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    means = (uniform(count, 3) * 2 - 1) * torch.tensor([2 * spread, spread, spread]) + torch.tensor(
        [0, 0, 1.5]
    )
    return Gaussians(
        means,
        torch.randn(count, 4, generator=generator, dtype=torch.float64),
        size * (0.2 + uniform(count, 3)),
        opacity[0] + (opacity[1] - opacity[0]) * uniform(count),
        torch.randn(count, k, 3, generator=generator, dtype=torch.float64) * 0.5,
    )


def one_gaussian(**changes):
    """Return a grey isotropic Gaussian at (0, 0, 2)."""
    values = {
        "means": torch.tensor([[0.0, 0.0, 2.0]]),
        "rotations": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "scales": torch.full((1, 3), 0.1),
        "opacities": torch.tensor([0.8]),
        "harmonics": torch.zeros(1, 1, 3),
    }
    return Gaussians(**(values | changes))


def broken_gaussians():
    """Return one Gaussian for each way not to be drawn, with its name."""
    good = one_gaussian()
    changes = {
        "behind": {"means": torch.tensor([[0.0, 0.0, -2.0]])},
        "too near": {"means": torch.tensor([[0.0, 0.0, 0.009]])},
        "outside": {"means": torch.tensor([[50.0, 0.0, 2.0]])},
        "transparent": {"opacities": torch.zeros(1)},
        "fainter than a step": {"opacities": torch.tensor([0.99 / 255])},
        "flat": {"scales": torch.tensor([[0.1, 0.0, 0.1]])},
        "negative scale": {"scales": torch.tensor([[0.1, -0.1, 0.1]])},
        "no rotation": {"rotations": torch.zeros(1, 4)},
    }
    for field in FIELDS:
        for value in (math.nan, math.inf):
            spoiled = getattr(good, field).clone()
            spoiled.flatten()[-1] = value
            changes[f"{value} in {field}"] = {field: spoiled}
    return {name: dataclasses.replace(good, **change) for name, change in changes.items()}


def concatenate(*parts):
    return Gaussians(*(torch.cat([getattr(part, field) for part in parts]) for field in FIELDS))


def render_with_gradients(gaussians, camera, backend, dtype, **options):
    """Return the images and the gradients of a fixed random weighting of all of them."""
    leaves = gaussians.map(lambda values: values.detach().to(dtype).clone().requires_grad_())
    background = torch.tensor([0.2, 0.5, 0.9], dtype=dtype, requires_grad=True)
    output = draw(leaves, camera, backend, background, **options)
    images = (output.color, output.alpha, output.depth)
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(i.shape, generator=generator, dtype=torch.float64).to(dtype) for i in images]
    loss = torch.stack([(image * weight).sum() for image, weight in zip(images, weights, strict=True)]).sum()
    inputs = {field: getattr(leaves, field) for field in FIELDS} | {"background": background}
    # An image without Gaussians depends on the background alone.
    gradients = torch.autograd.grad(loss, list(inputs.values()), materialize_grads=True)
    named_images = dict(zip(("color", "alpha", "depth"), images, strict=True))
    return named_images, dict(zip(inputs, gradients, strict=True))


def assert_same_image(fast, slow, name):
    """Compare images to 1e-4; a fragment right at the 1/255 cut-off may fall on either side of it."""
    error = (fast - slow).detach().abs().flatten()
    assert (~(error <= 1e-4)).float().mean() <= 0.002, name
    assert name == "depth" or (error < 0.01).all(), name


SCENES = {
    "random": make_gaussians(300, k=4),
    "dense": make_gaussians(3000, k=1, opacity=(0.8, 1.0)),
    "saturated": make_gaussians(40, k=16, size=0.4, opacity=(1.0, 1.0)),
    "edge of the frustum": make_gaussians(400, k=9, spread=1.45, size=0.3),
    "tiny": make_gaussians(300, k=4, size=1e-4),
    "long and thin": dataclasses.replace(
        make_gaussians(60, k=1),
        scales=torch.tensor([0.3, 0.003, 0.0003], dtype=torch.float64).expand(60, 3),
    ),
    "with broken ones": concatenate(
        make_gaussians(50, seed=2),
        *(gaussian.map(torch.Tensor.double) for gaussian in broken_gaussians().values()),
        make_gaussians(50, seed=3),
    ),
    "empty": make_gaussians(0),
}


EXTRAS = ("median_depth", "first_hit_depth", "largest_weight_id", "contributors")
