"""What must not change an image: the order of Gaussians, and moving scene and camera together."""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from raster_scenes import WARP

from dsar.geometry.harmonics import rotate_harmonics
from dsar.geometry.rotations import matrix_from_quaternion, quaternion_multiply
from dsar.raster import rasterize
from dsar.types import Camera, Gaussians

SEEDS = st.integers(0, 2**31)


def make_scene(seed):
    """Return 80 Gaussians and a camera 2 m before them."""
    generator = torch.Generator().manual_seed(seed)
    gaussians = Gaussians(
        torch.rand(80, 3, generator=generator) - 0.5,
        torch.nn.functional.normalize(torch.randn(80, 4, generator=generator), dim=-1),
        0.02 + 0.1 * torch.rand(80, 3, generator=generator),
        torch.rand(80, generator=generator),
        torch.randn(80, 16, 3, generator=generator) * 0.3,
    )
    transform = torch.eye(4)
    transform[2, 3] = 2.0
    K = torch.tensor([[50.0, 0.0, 21.0], [0.0, 52.0, 15.0], [0.0, 0.0, 1.0]])
    return gaussians, Camera(K, transform, 41, 29, "view")


def assert_same_image(one, other, tolerance):
    """Compare two renderings; a fragment right at the 1/255 cut-off may fall on either side of it."""
    error = (one.color - other.color).abs().amax(-1)
    assert (error > tolerance).float().mean() < 0.003
    assert error.max() < 0.01


@pytest.mark.parametrize("backend", ["reference", "cpu", WARP])
@settings(max_examples=8, deadline=None)
@given(seed=SEEDS)
def test_order_of_gaussians_does_not_matter(backend, seed):
    gaussians, camera = make_scene(seed)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(seed))
    image = rasterize(gaussians, camera, backend=backend)
    shuffled = rasterize(gaussians.map(lambda values: values[order]), camera, backend=backend)
    assert_same_image(image, shuffled, 1e-6)


@pytest.mark.parametrize("backend", ["reference", "cpu", WARP])
@settings(max_examples=8, deadline=None)
@given(seed=SEEDS)
def test_moving_scene_and_camera_together_does_not_matter(backend, seed):
    gaussians, camera = make_scene(seed)
    generator = torch.Generator().manual_seed(seed)
    turn = torch.nn.functional.normalize(torch.randn(4, generator=generator), dim=0)
    motion = torch.eye(4)
    motion[:3, :3] = matrix_from_quaternion(turn)
    motion[:3, 3] = torch.randn(3, generator=generator)
    moved = dataclasses.replace(
        gaussians,
        means=gaussians.means @ motion[:3, :3].T + motion[:3, 3],
        rotations=quaternion_multiply(turn.expand(80, 4), gaussians.rotations),
        harmonics=rotate_harmonics(gaussians.harmonics, turn.expand(80, 4)),
    )
    moved_camera = dataclasses.replace(
        camera, T_camera_world=camera.T_camera_world @ torch.linalg.inv(motion)
    )
    image = rasterize(gaussians, camera, backend=backend)
    moved_image = rasterize(moved, moved_camera, backend=backend)
    assert_same_image(image, moved_image, 1e-4)


@pytest.mark.parametrize("backend", ["cpu", WARP])
@settings(max_examples=15, deadline=None)
@given(seed=SEEDS, k=st.sampled_from([1, 4, 9, 16]))
def test_alpha_and_color_stay_in_range_and_gradients_stay_finite(backend, seed, k):
    gaussians, camera = make_scene(seed)
    generator = torch.Generator().manual_seed(seed)
    wild = dataclasses.replace(
        gaussians,
        means=3 * torch.randn(80, 3, generator=generator),
        scales=10 ** (8 * torch.rand(80, 3, generator=generator) - 5),
        harmonics=torch.randn(80, k, 3, generator=generator),
    ).map(torch.Tensor.requires_grad_)
    output = rasterize(wild, camera, backend=backend)
    assert output.alpha.min() >= 0
    assert output.alpha.max() <= 1
    assert output.color.min() >= 0
    (output.color.sum() + output.alpha.sum() + output.depth.sum()).backward()
    for field in dataclasses.fields(wild):
        assert getattr(wild, field.name).grad.isfinite().all(), field.name
