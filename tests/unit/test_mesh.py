"""Meshes in images, against rays through every pixel's centre."""

import numpy as np
import pytest
import torch

from dsar.geometry.cameras import look_at, unproject
from dsar.raster.mesh import rasterize_mesh
from dsar.types import Camera


@pytest.fixture
def camera():
    K = torch.tensor([[30.0, 0.0, 15.3], [0.0, 32.0, 11.8], [0.0, 0.0, 1.0]])
    return Camera(K, look_at(np.array([0.3, 0.4, 2.0]), np.zeros(3)), 32, 24, "cam")


def cast(vertices, faces, camera):
    """Return the nearest triangle and its weights by solving for each ray and triangle."""
    rows, columns = torch.meshgrid(torch.arange(24) + 0.5, torch.arange(32) + 0.5, indexing="ij")
    pixels = torch.stack([columns, rows], -1).double()
    origin = camera.center.double()
    direction = unproject(camera, pixels, torch.ones(24, 32, dtype=torch.float64)) - origin
    found = torch.full((24, 32), -1)
    nearest, weights = torch.full((24, 32), torch.inf, dtype=torch.float64), torch.zeros(24, 32, 3).double()
    for index, corners in enumerate(vertices.double()[faces]):
        # corners.T @ w = origin + t direction, with weights that sum to one.
        system = torch.zeros(24, 32, 4, 4, dtype=torch.float64)
        system[..., :3, :3], system[..., 3, :3] = corners.T, 1.0
        system[..., :3, 3] = -direction
        right = torch.cat([origin, torch.ones(1, dtype=torch.float64)]).expand(24, 32, 4)
        solved = torch.linalg.solve(system, right)
        w, t = solved[..., :3], solved[..., 3]
        closer = (w >= 0).all(-1) & (t < nearest) & (t > 0)
        found[closer], nearest[closer], weights[closer] = index, t[closer], w[closer]
    return found, weights, nearest


def test_each_pixel_sees_what_a_ray_through_its_centre_hits(camera):
    generator = torch.Generator().manual_seed(0)
    centers = torch.rand(40, 1, 3, generator=generator) * 2 - 1
    vertices = (centers + 0.4 * torch.randn(40, 3, 3, generator=generator)).flatten(0, 1)
    # Triangles that cross the camera's plane are left out by both.
    depth = (vertices @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3])[:, 2]
    faces = torch.arange(120).reshape(40, 3)
    faces = faces[(depth[faces] > 0.01).all(1)]
    view = rasterize_mesh(vertices, faces, camera)
    found, weights, depths = cast(vertices, faces, camera)
    assert (found >= 0).float().mean() > 0.4
    assert len(found.unique()) > 15
    assert torch.equal(view.faces, found)
    hit = found >= 0
    torch.testing.assert_close(view.weights[hit].double(), weights[hit], atol=1e-4, rtol=0)
    torch.testing.assert_close(view.depth[hit].double(), depths[hit], atol=1e-4, rtol=1e-4)
    assert torch.isinf(view.depth[~hit]).all()


def test_what_is_behind_the_camera_is_not_drawn(camera):
    vertices = torch.tensor([[0.0, 0.0, 3.0], [1.0, 0.0, 3.0], [0.0, 1.0, 3.0]])
    assert (rasterize_mesh(vertices, torch.tensor([[0, 1, 2]]), camera).faces == -1).all()
