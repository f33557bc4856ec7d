"""Proxy geometry by two renderers, pixel by pixel."""

import math

import pytest
import torch

from dsar.body.files import load_body
from dsar.geometry.cameras import project
from dsar.types import Camera, Gaussians
from dsar_render.crosscheck.proxies import Hits, MitsubaScene, Shape, compare, ellipsoids, rasterize_shapes


def shapes(cloud: Gaussians) -> list[Shape]:
    body = load_body()
    return [Shape("body", body.vertices, body.faces), ellipsoids(cloud)]


@pytest.mark.parametrize("variant", ["scalar", "llvm"])
def test_both_see_the_same_silhouettes_depths_and_shapes(request, variant, oblong, cloud):
    mi = request.getfixturevalue(variant)
    made = shapes(cloud)
    found = compare(rasterize_shapes(made, oblong), MitsubaScene(mi, made).trace(oblong))
    assert found.iou > 0.999
    assert found.depth_mae < 1e-4
    assert found.shapes > 0.999


def test_a_shift_of_a_pixel_shows(scalar, oblong, cloud):
    made = shapes(cloud)
    shifted = oblong.cropped(1, 0, oblong.width, oblong.height)
    right, wrong = (
        compare(rasterize_shapes(made, each), MitsubaScene(scalar, made).trace(oblong))
        for each in (oblong, shifted)
    )
    assert wrong.iou < 0.99 < right.iou
    assert wrong.depth_mae > 10 * right.depth_mae


def test_ellipsoids_end_at_one_and_a_half_deviations():
    one = Gaussians(
        means=torch.tensor([[0.1, 0.2, 0.3]]),
        rotations=torch.tensor([[math.cos(0.3), 0.0, 0.0, math.sin(0.3)]]),
        scales=torch.tensor([[0.3, 0.2, 0.1]]),
        opacities=torch.ones(1),
        harmonics=torch.zeros(1, 1, 3),
    )
    shape = ellipsoids(one)
    turn = torch.tensor(
        [[math.cos(0.6), -math.sin(0.6), 0.0], [math.sin(0.6), math.cos(0.6), 0.0], [0.0, 0.0, 1.0]]
    )
    local = (shape.vertices - one.means) @ turn / one.scales
    torch.testing.assert_close(local.norm(dim=-1), torch.full((len(local),), 1.5))


def test_agreement_counts_what_it_says():
    shapes = torch.tensor([[0, 0, 1, -1]])
    depth = torch.tensor([[1.0, 2.0, 3.0, torch.inf]])
    other = Hits(torch.tensor([[0, 1, -1, -1]]), torch.tensor([[1.5, 2.0, torch.inf, torch.inf]]))
    found = compare(Hits(shapes, depth), other)
    assert found.iou == pytest.approx(2 / 3)
    assert found.depth_mae == pytest.approx(0.25)
    assert found.shapes == pytest.approx(0.5)


def test_depth_is_along_the_cameras_axis(scalar, oblong: Camera):
    """A plane across the axis has one depth everywhere, which distances from the camera have not."""
    corners = torch.tensor([[-9.0, -9.0, 2.0], [9.0, -9.0, 2.0], [9.0, 9.0, 2.0], [-9.0, 9.0, 2.0]])
    T = oblong.T_camera_world
    plane = Shape("plane", (corners - T[:3, 3]) @ T[:3, :3], torch.tensor([[0, 1, 2], [0, 2, 3]]))
    torch.testing.assert_close(project(oblong, plane.vertices)[1], torch.full((4,), 2.0))
    seen = MitsubaScene(scalar, [plane]).trace(oblong)
    assert seen.hit.all()
    torch.testing.assert_close(seen.depth, torch.full_like(seen.depth, 2.0), atol=1e-5, rtol=0)
