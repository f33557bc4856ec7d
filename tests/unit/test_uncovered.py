"""The body that a lifted garment leaves free, on a garment of our own making."""

import math

import pytest
import torch

from dsar.avatar.garment_chart import PAST_HEM, tube_faces
from dsar.evaluation.uncovered import FEWEST, RestingGarment, psnr_uncovered, touched_pixels
from dsar.evaluation.views import View
from dsar.geometry.cameras import look_at
from dsar.raster.mesh import rasterize_mesh
from dsar.types import Camera

ROWS, COLUMNS, SIZE = 12, 24, 64


@pytest.fixture
def camera():
    K = torch.tensor([[60.0, 0.0, SIZE / 2], [0.0, 60.0, SIZE / 2], [0.0, 0.0, 1.0]])
    transform = look_at(torch.tensor([0.0, 0.0, 2.0]).double().numpy(), torch.zeros(3).double().numpy())
    return Camera(K, transform, SIZE, SIZE, "front")


def tube(top: float, bottom: float, radius: float = 0.3):
    azimuth = (torch.arange(COLUMNS) + 0.5) / COLUMNS * 2 * math.pi - math.pi
    heights = torch.linspace(top, bottom, ROWS)[:, None].expand(ROWS, COLUMNS)
    x, z = (radius * wave.expand(ROWS, COLUMNS) for wave in (azimuth.sin(), azimuth.cos()))
    return torch.stack([x, heights, z], -1).reshape(-1, 3)


def silhouette(camera, top, bottom, transform=None):
    """Where a tube on a single joint is when it rests, its chart going on past the hem."""
    positions = tube(top, bottom - PAST_HEM).unflatten(0, (ROWS, COLUMNS))
    garment = RestingGarment(positions, torch.ones(ROWS, COLUMNS, 1))
    return garment.silhouette(torch.eye(4)[None] if transform is None else transform[None], camera)


def test_a_tube_s_triangles_close_it_and_face_outwards():
    points, faces = tube(0.4, -0.4), tube_faces(ROWS, COLUMNS)
    assert len(faces) == 2 * (ROWS - 1) * COLUMNS
    a, b, c = points[faces].unbind(1)
    outwards = torch.linalg.cross(b - a, c - a) * ((a + b + c) / 3 * torch.tensor([1.0, 0.0, 1.0]))
    assert (outwards.sum(-1) > 0).all()
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
    counts = edges.unique(dim=0, return_counts=True)[1]
    assert (counts == 1).sum() == 2 * COLUMNS


def test_only_pixels_that_the_lifted_garment_leaves_free_count(camera):
    resting = silhouette(camera, 0.4, -0.4)
    lifted = touched_pixels(tube(0.4, 0.0), tube_faces(ROWS, COLUMNS), camera)
    mask = torch.zeros(SIZE, SIZE)
    mask[:, 28:36] = 1.0
    truth = View(torch.full((SIZE, SIZE, 3), 0.5), mask)
    wrong = truth.color.clone()
    free = resting & ~lifted & (mask > 0.5)
    assert 8 * 8 < int(free.sum()) < 8 * 14
    wrong[~free] = 0.0
    assert psnr_uncovered(wrong, truth, lifted, resting) == pytest.approx(100.0)
    wrong = truth.color.clone()
    wrong[free] += 0.1
    assert psnr_uncovered(wrong, truth, lifted, resting) == pytest.approx(20.0, abs=1e-3)


def test_a_garment_at_rest_leaves_nothing_free(camera):
    faces = tube_faces(ROWS, COLUMNS)
    resting = silhouette(camera, 0.4, -0.4)
    covered = touched_pixels(tube(0.4, -0.4), faces, camera)
    truth = View(torch.rand(SIZE, SIZE, 3), torch.ones(SIZE, SIZE))
    assert int((resting & ~covered).sum()) < FEWEST
    assert psnr_uncovered(torch.zeros(SIZE, SIZE, 3), truth, covered, resting) is None


def test_the_silhouette_moves_with_the_skeleton(camera):
    moved = torch.eye(4)
    moved[0, 3] = 5 * 1.7 / 60
    still, shifted = (silhouette(camera, 0.4, -0.4, transform) for transform in (torch.eye(4), moved))
    overlap = (still.roll(5, 1) & shifted).sum() / shifted.sum()
    assert overlap > 0.9


def test_a_pixel_is_touched_by_a_garment_at_any_of_its_samples(camera):
    vertices = torch.tensor([[-0.2, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.2, 0.0]])
    faces = torch.tensor([[0, 1, 2]])
    coarse = touched_pixels(vertices, faces, camera)
    fine = camera.resized(2 * SIZE, 2 * SIZE)
    hit = rasterize_mesh(vertices, faces, fine).faces >= 0
    for row, column in coarse.nonzero().tolist():
        assert hit[2 * row : 2 * row + 2, 2 * column : 2 * column + 2].any()
    rows, columns = hit.nonzero().T
    assert coarse[rows // 2, columns // 2].all()
