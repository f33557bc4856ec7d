"""Shapes whose distances are known."""

import math

import pytest
import torch

from dsar.data.captures.formats import open_capture
from dsar.evaluation.garment_metrics import (
    closest_on_triangles,
    distance_to_mesh,
    garment_mask,
    hem_loop,
    measure_hem,
    measure_jitter,
    measure_shape,
)
from dsar.types import Camera


def skirt(around: int = 60, rows: int = 20, top: float = 0.1, bottom: float = 0.3):
    """A cone that hangs from y = 1 down to y = 0.5; its hem is the last row."""
    angle = torch.arange(around) * (2 * math.pi / around)
    share = torch.linspace(0, 1, rows + 1)
    radius = top + (bottom - top) * share
    x, z = (radius[:, None] * wave for wave in (angle.cos(), angle.sin()))
    vertices = torch.stack([x, (1 - 0.5 * share)[:, None].expand_as(x), z], -1).reshape(-1, 3)
    corner = torch.arange(rows)[:, None] * around + torch.arange(around)
    right = torch.arange(rows)[:, None] * around + (torch.arange(around) + 1) % around
    faces = torch.stack(
        [
            torch.stack([corner, right, corner + around], -1),
            torch.stack([right, right + around, corner + around], -1),
        ]
    )
    return vertices, faces.reshape(-1, 3)


def test_the_nearest_point_of_a_triangle_is_that_of_a_fine_grid_on_it():
    generator = torch.Generator().manual_seed(0)
    triangles, points = (torch.randn(40, *s, generator=generator) for s in ((3, 3), (3,)))
    found = closest_on_triangles(points, triangles)
    steps = torch.arange(401) / 400
    s, t = (x.flatten() for x in torch.meshgrid(steps, steps, indexing="ij"))
    s, t = s[s + t <= 1], t[s + t <= 1]
    for point, triangle, close in zip(points, triangles, found, strict=True):
        grid = (
            triangle[0] + s[:, None] * (triangle[1] - triangle[0]) + t[:, None] * (triangle[2] - triangle[0])
        )
        best = float((grid - point).norm(dim=-1).amin())
        assert float((close - point).norm()) <= best + 1e-5
        assert float((close - point).norm()) >= best - 0.02


def test_a_cloud_beside_the_surface_is_as_far_as_it_was_moved():
    vertices, faces = skirt()
    triangles = vertices[faces]
    normals = torch.linalg.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lifted = triangles.mean(1) + 0.013 * normals / normals.norm(dim=-1, keepdim=True)
    distance = distance_to_mesh(lifted, vertices, faces)
    # Inside the cone a neighbouring facet may be nearer, by the angle between them.
    assert torch.allclose(distance, torch.full_like(distance, 0.013), rtol=0.01)
    on_it = measure_shape(triangles.mean(1), vertices, faces)
    assert on_it["chamfer"] < 0.01
    assert on_it["fscore"] == 1
    away = measure_shape(lifted + torch.tensor([1.0, 0, 0]), vertices, faces)
    assert away["chamfer"] > 0.5
    assert away["fscore"] == 0


def test_half_a_garment_is_precise_but_not_complete():
    vertices, faces = skirt()
    centers = vertices[faces].mean(1)
    half = measure_shape(centers[centers[:, 0] > 0], vertices, faces)
    precision, recall = 1.0, 0.5
    assert half["fscore"] == pytest.approx(2 * precision * recall / (precision + recall), abs=0.06)


def test_the_hem_is_the_lowest_border():
    vertices, faces = skirt()
    loop = hem_loop(vertices, faces)
    assert loop.tolist() == list(range(20 * 60, 21 * 60))
    radius, height = measure_hem(vertices[loop])
    assert radius == pytest.approx(0.3, abs=1e-5)
    assert height == pytest.approx(0.5, abs=1e-5)
    # Wherever the person goes.
    assert measure_hem(vertices[loop] + torch.tensor([3.0, 0.0, 2.0])) == pytest.approx((0.3, 0.5), abs=1e-5)


def test_jitter_is_the_jerk_of_a_path():
    t = torch.arange(30.0).double() / 24
    # x = 2 t³ m has a jerk of 12 m/s³, a steady acceleration none.
    cubic, steady = (torch.stack([x, 0 * x, 0 * x], -1)[:, None] for x in (2 * t**3, 3 * t**2))
    assert measure_jitter(cubic, 24.0) == pytest.approx(12, rel=1e-6)
    assert measure_jitter(steady, 24.0) == pytest.approx(0, abs=1e-6)
    assert measure_jitter(steady[:3], 24.0) == 0


def test_the_true_garment_is_where_the_images_show_a_person():
    capture = open_capture()
    vertices, faces = torch.from_numpy(capture.garment("far")), torch.from_numpy(capture.garment_faces("far"))
    for frame, camera in ((0, 0), (45, 3), (70, 6)):
        mask = garment_mask(vertices[frame], faces, capture.cameras[camera])
        person = torch.from_numpy(capture.image("far", frame, camera)[..., 3] > 127)
        assert (mask & person).sum() > 0.97 * mask.sum()
        # It is a skirt, whose lowest pixel is above the feet.
        assert 0.15 < mask.sum() / person.sum() < 0.7
        assert mask.any(1).nonzero().max() < person.any(1).nonzero().max() - 10


def test_a_square_covers_the_pixels_that_the_camera_projects_it_to():
    K = torch.tensor([[20.0, 0.0, 16.0], [0.0, 20.0, 12.0], [0.0, 0.0, 1.0]])
    camera = Camera(K, torch.eye(4), 32, 24, "front")
    # At 2 m a metre is ten pixels: from 6.2 to 25.8 across and from 7.4 to 16.6 down.
    x, y = 0.98, 0.46
    vertices = torch.tensor([[-x, -y, 2.0], [x, -y, 2.0], [x, y, 2.0], [-x, y, 2.0]])
    mask = garment_mask(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), camera)
    expected = torch.zeros(24, 32, dtype=torch.bool)
    expected[7:17, 6:26] = True
    assert torch.equal(mask, expected)
