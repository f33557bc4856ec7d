"""Known points: where another renderer sees small spheres, to a hundredth of a pixel.

The image of a sphere is an ellipse, whose middle is not where the sphere's own centre falls: for a sphere of
radius r at (x, y, z) before the camera it is that of the point (x, y, z - r²/z).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.geometry.cameras import project, unproject
from dsar.types import Camera
from dsar_render.crosscheck.sensors import make_sensor, square_pixels

COLUMNS, ROWS = 5, 5
"""Of the grid in which the spheres stand in the image."""
_SAMPLES = 64
_RADIUS_PX, _RADIUS = 3.0, 1 / 64
"""Of a sphere's image: in pixels at least, else a share of the shorter side of what is rendered."""
_DEPTHS_M = (1.0, 8.0)
_MOST_PIXELS = 1024
"""Of the longer side of an image that is rendered; larger cameras are looked through at this size."""
_MIN_VISIBLE = 0.5
"""Share of a sphere's area that must be in the image for its middle to count."""

Projection = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n 2"]]
"""From world metres to pixels."""


@dataclass(frozen=True)
class SphereObservations:
    """Where Mitsuba saw points."""

    points: Float[Tensor, "n 3"]
    """World metres."""
    pixels: Float[Tensor, "n 2"]
    """Places in the image, not finite where a point was not seen."""

    def residuals(self, project: Projection) -> Float[Tensor, " n"]:
        """Return how many pixels a projection is off at each point; infinite where none was seen."""
        distance = (project(self.points) - self.pixels).norm(dim=-1)
        return torch.where(distance.isfinite(), distance, torch.inf)


@dataclass(frozen=True)
class Residuals:
    """How far a projection is from where Mitsuba saw points, in pixels."""

    rms: float
    max: float

    @classmethod
    def from_distances(cls, distances: Float[Tensor, " n"]) -> "Residuals":
        """Return the figures of some distances."""
        return cls(float(distances.square().mean().sqrt()), float(distances.max()))


def camera_projection(camera: Camera) -> Projection:
    """Return our own projection."""
    return lambda points: project(camera, points)[0]


def matrix_projection(matrix: Float[np.ndarray, "4 4"]) -> Projection:
    """Return the projection of a matrix for column vectors; rows 0, 1 and 3 are pixels times w, and w."""
    rows = torch.from_numpy(matrix)[[0, 1, 3]]

    def through(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
        image = torch.cat([points, torch.ones_like(points[:, :1])], -1) @ rows.to(points).T
        return image[:, :2] / image[:, 2:]

    return through


def place_spheres(camera: Camera, seed: int = 0) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Return centres (world metres) and radii of spheres that a camera sees apart from each other.

    They stand in a loose grid over the image, 1 to 8 metres away.
    """
    random = torch.Generator().manual_seed(seed)
    count = COLUMNS * ROWS
    index = torch.arange(count)
    cells = torch.stack([index % COLUMNS, index // COLUMNS], -1).double()
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    cell = size / torch.tensor([COLUMNS, ROWS])
    radius = max(_RADIUS_PX, _RADIUS * min(camera.width, camera.height))
    room = (cell / 2 - radius - 1).clamp_min(0)
    jitter = torch.rand(count, 2, generator=random, dtype=torch.float64) * 2 - 1
    pixels = (cells + 0.5) * cell + jitter * room
    near, far = (torch.tensor(depth, dtype=torch.float64).log() for depth in _DEPTHS_M)
    depths = torch.lerp(near, far, torch.rand(count, generator=random, dtype=torch.float64)).exp()
    centers = unproject(camera, pixels, depths)
    focal = float(camera.K.diagonal()[:2].max())
    return centers, radius * depths / (focal * _obliqueness(camera, centers))


def project_spheres(mi: Any, camera: Camera, seed: int = 0) -> SphereObservations:
    """Return where Mitsuba sees spheres through a camera, in that camera's pixels."""
    shrink = min(1.0, _MOST_PIXELS / max(camera.width, camera.height))
    view = camera.resized(round(camera.width * shrink), round(camera.height * shrink))
    centers, radii = place_spheres(view, seed)
    square, taller = square_pixels(view)
    image = _render(mi, square, centers, radii)
    pixels = _centroids(image, len(centers), _apparent_area(square, centers, radii))
    size = torch.tensor([view.width / camera.width, taller * view.height / camera.height])
    return SphereObservations(_centers_of_images(view, centers, radii), pixels / size)


def _render(
    mi: Any, camera: Camera, centers: Float[Tensor, "n 3"], radii: Float[Tensor, " n"]
) -> Float[np.ndarray, "h w 3"]:
    """Return an image of shining spheres whose green light, beside the red, says which one it is."""
    scene: dict[str, Any] = {
        "type": "scene",
        # Light that comes straight from the spheres, none that they throw on each other.
        "integrator": {"type": "path", "max_depth": 1},
        "sensor": make_sensor(mi, camera, _SAMPLES),
    }
    for index, (center, radius) in enumerate(zip(centers.tolist(), radii.tolist(), strict=True)):
        light = {"type": "rgb", "value": [1.0, (index + 1) / (len(centers) + 1), 0.0]}
        scene[f"sphere_{index}"] = {
            "type": "sphere",
            "center": center,
            "radius": radius,
            "emitter": {"type": "area", "radiance": light},
        }
    return np.array(mi.render(mi.load_dict(scene), spp=_SAMPLES))[..., :3]


def _centroids(
    image: Float[np.ndarray, "h w 3"], count: int, areas: Float[Tensor, " n"]
) -> Float[Tensor, "n 2"]:
    """Return the middle of each sphere's light."""
    light = torch.from_numpy(image[..., 0]).double().flatten()
    green = torch.from_numpy(image[..., 1]).double().flatten()
    rows, columns = torch.meshgrid(*(torch.arange(side) + 0.5 for side in image.shape[:2]), indexing="ij")
    places = torch.stack([columns.flatten(), rows.flatten()], -1).double()
    lit = light > 0
    which = (green[lit] / light[lit] * (count + 1)).round().long() - 1
    valid = (which >= 0) & (which < count)
    which, weights, places = which[valid], light[lit][valid], places[lit][valid]
    total = torch.zeros(count, dtype=torch.float64).index_add_(0, which, weights)
    sums = torch.zeros(count, 2, dtype=torch.float64).index_add_(0, which, weights[:, None] * places)
    centroids = sums / total[:, None]
    centroids[total < _MIN_VISIBLE * areas] = torch.inf
    return centroids


def _in_camera(camera: Camera, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    transform = camera.T_camera_world.to(points)
    return points @ transform[:3, :3].T + transform[:3, 3]


def _centers_of_images(
    camera: Camera, centers: Float[Tensor, "n 3"], radii: Float[Tensor, " n"]
) -> Float[Tensor, "n 3"]:
    """Return the world points that fall on the centroids of the spheres' images."""
    local = _in_camera(camera, centers)
    local[:, 2] -= radii**2 / local[:, 2]
    transform = camera.T_camera_world.to(local)
    return (local - transform[:3, 3]) @ transform[:3, :3]


def _obliqueness(camera: Camera, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Return how much longer the way to points is than their depth: so much longer are spheres' images."""
    local = _in_camera(camera, points)
    return local.norm(dim=-1) / local[:, 2]


def _apparent_area(
    camera: Camera, centers: Float[Tensor, "n 3"], radii: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """Return about how many pixels each sphere covers."""
    depth = _in_camera(camera, centers)[:, 2]
    return torch.pi * (radii * camera.K[0, 0].double() / depth) ** 2 * _obliqueness(camera, centers)
