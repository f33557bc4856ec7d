"""Rotations, cameras and harmonics, drawn at random, degenerate cases on purpose."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dsar.geometry.cameras import look_at, project, unproject, world_from_camera
from dsar.geometry.harmonics import color_from_harmonics, harmonics_basis, rotate_harmonics
from dsar.geometry.rotations import (
    axis_angle_from_matrix,
    heading_matrix,
    matrix_from_axis_angle,
    matrix_from_quaternion,
    nearest_rotation,
    quaternion_from_axis_angle,
    quaternion_from_matrix,
    quaternion_multiply,
)
from dsar.types import Camera

seeds = st.integers(0, 2**31)
angles = st.sampled_from([0.0, 1e-8, 1e-3, 1.0, 3.1, 3.14159])


def draw(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def unit(x: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.normalize(x, dim=-1)


@given(seeds, angles)
def test_axis_angle_survives_the_way_through_a_matrix(seed, angle):
    axis_angle = unit(draw(seed, 8, 3)) * angle
    matrix = matrix_from_axis_angle(axis_angle)
    back = matrix_from_axis_angle(axis_angle_from_matrix(matrix))
    assert torch.allclose(back, matrix, atol=1e-7)
    assert torch.allclose(matrix @ matrix.mT, torch.eye(3, dtype=torch.float64).expand(8, 3, 3), atol=1e-12)


@given(seeds)
def test_quaternion_product_is_the_matrix_product(seed):
    a, b = unit(draw(seed, 5, 4)), unit(draw(seed + 1, 5, 4))
    product = matrix_from_quaternion(quaternion_multiply(a, b))
    assert torch.allclose(product, matrix_from_quaternion(a) @ matrix_from_quaternion(b), atol=1e-12)
    assert torch.allclose(matrix_from_quaternion(quaternion_from_matrix(product)), product, atol=1e-12)


def test_axis_angle_gradient_is_finite_at_zero():
    zero = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    quaternion_from_axis_angle(zero).sum().backward()
    assert torch.isfinite(zero.grad).all()
    assert torch.autograd.gradcheck(quaternion_from_axis_angle, (draw(0, 4, 3).requires_grad_(),))


@given(seeds)
def test_nearest_rotation_undoes_a_symmetric_stretch(seed):
    rotation = matrix_from_axis_angle(draw(seed, 4, 3))
    stretch = draw(seed + 1, 4, 3, 3) * 0.2
    stretch = torch.eye(3, dtype=torch.float64) + stretch @ stretch.mT
    assert torch.allclose(nearest_rotation(rotation @ stretch), rotation, atol=1e-9)


@given(seeds)
def test_heading_follows_a_yaw_and_is_upright(seed):
    rotation, yaw = matrix_from_axis_angle(draw(seed, 6, 3)), draw(seed + 1, 1)
    turn = matrix_from_axis_angle(torch.stack([0 * yaw, yaw, 0 * yaw], -1))
    assert torch.allclose(heading_matrix(turn @ rotation), turn @ heading_matrix(rotation), atol=1e-8)
    assert torch.allclose(heading_matrix(rotation)[:, 1], torch.tensor([0.0, 1, 0]).double().expand(6, 3))


def camera(seed: int) -> Camera:
    rotation = matrix_from_axis_angle(draw(seed, 3))
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3], transform[:3, 3] = rotation, draw(seed + 1, 3)
    K = torch.tensor([[210.0, 0, 90], [0, 190, 140], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, transform, 192, 256, "cam")


@given(seeds)
def test_unproject_inverts_project(seed):
    view = camera(seed)
    pixels, depth = draw(seed, 10, 2) * 50 + 100, draw(seed + 2, 10).abs() + 0.5
    points = unproject(view, pixels, depth)
    again, z = project(view, points)
    assert torch.allclose(again, pixels, atol=1e-8)
    assert torch.allclose(z, depth)


@given(seeds)
def test_crop_and_resize_move_pixels_as_they_say(seed):
    view = camera(seed)
    points = unproject(view, draw(seed, 10, 2) * 50 + 100, draw(seed + 2, 10).abs() + 0.5)
    pixels, _ = project(view, points)
    cropped, _ = project(view.cropped(7, 11, 50, 60), points)
    halved, _ = project(view.resized(96, 128), points)
    assert torch.allclose(cropped, pixels - torch.tensor([7.0, 11.0]).double(), atol=1e-8)
    assert torch.allclose(halved, pixels / 2, atol=1e-8)


def test_conventions_agree_on_where_the_camera_looks():
    import numpy as np

    transform = look_at(np.array([0.0, 1.5, 3.0]), np.array([0.0, 1.0, 0.0]))
    view = Camera(torch.eye(3), transform, 2, 2, "cam")
    forward = np.array([0.0, -0.5, -3.0]) / np.hypot(0.5, 3.0)
    assert np.allclose(world_from_camera(view, "opencv")[:3, 2], forward, atol=1e-6)
    assert np.allclose(world_from_camera(view, "opengl")[:3, 2], -forward, atol=1e-6)
    assert np.allclose(
        world_from_camera(view, "opengl")[:3, 1] @ [0, 1, 0], np.hypot(3, 0) / np.hypot(0.5, 3)
    )
    assert np.allclose(world_from_camera(view, "mitsuba")[:3, 0], -world_from_camera(view, "opengl")[:3, 0])
    assert np.allclose(view.center, [0.0, 1.5, 3.0], atol=1e-6)


@given(seeds, st.sampled_from([4, 9, 16]))
@settings(max_examples=30)
def test_rotated_harmonics_shine_the_same_in_rotated_directions(seed, count):
    harmonics, quaternions = draw(seed, 3, count, 3), unit(draw(seed + 1, 3, 4))
    directions = unit(draw(seed + 2, 3, 3))
    turned = torch.einsum("nij,nj->ni", matrix_from_quaternion(quaternions), directions)
    rotated = rotate_harmonics(harmonics, quaternions)
    assert torch.allclose(
        color_from_harmonics(rotated, turned), color_from_harmonics(harmonics, directions), atol=1e-9
    )
    for degree in range(1, round(count**0.5)):
        band = slice(degree**2, (degree + 1) ** 2)
        assert torch.allclose(rotated[:, band].norm(dim=1), harmonics[:, band].norm(dim=1))


def test_harmonics_are_orthonormal():
    generator = torch.Generator().manual_seed(0)
    directions = unit(torch.randn(400_000, 3, generator=generator, dtype=torch.float64))
    basis = harmonics_basis(directions, 16)
    gram = 4 * torch.pi * basis.T @ basis / len(basis)
    # Monte Carlo over 4e5 directions: standard error below 0.005.
    assert torch.allclose(gram, torch.eye(16, dtype=torch.float64), atol=0.02)
