"""Proxy geometry: what stands for an avatar where a renderer knows nothing of Gaussians, seen by both.

Rays go through the centres of pixels on either side, so silhouettes, depths and shapes can be compared pixel
by pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from dsar.errors import MissingDependencyError
from dsar.geometry.rotations import matrix_from_quaternion
from dsar.raster.mesh import rasterize_mesh
from dsar.types import Camera, Gaussians
from dsar_render.crosscheck.sensors import make_sensor, pixel_centers, square_pixels

_SUBDIVISIONS = 1
_DEVIATIONS = 1.5
"""Standard deviations at which a Gaussian's ellipsoid ends."""


@dataclass(frozen=True)
class Shape:
    """A triangle mesh in world metres."""

    name: str
    vertices: Float[Tensor, "v 3"]
    faces: Int64[Tensor, "f 3"]


@dataclass(frozen=True)
class Hits:
    """What the centres of pixels see of shapes."""

    shapes: Int64[Tensor, "h w"]
    """Which shape; -1 where there is none."""
    depth: Float[Tensor, "h w"]
    """Camera-space depth, metres; infinite where there is nothing."""

    @property
    def hit(self) -> Bool[Tensor, "h w"]:
        """Where there is something."""
        return self.shapes >= 0


@dataclass(frozen=True)
class Agreement:
    """How well two renderers agree on proxy geometry."""

    iou: float
    """Of the silhouettes."""
    depth_mae: float
    """Mean absolute difference in metres where both see something; NaN where they never do."""
    shapes: float
    """Share of those pixels in which both see the same shape."""


def ellipsoids(gaussians: Gaussians) -> Shape:
    """Return an ellipsoid for each Gaussian.

    Raises:
        MissingDependencyError: trimesh is not installed.
    """
    try:
        import trimesh
    except ImportError as error:
        raise MissingDependencyError("dsar crosscheck", "trimesh", "mitsuba") from error
    ball = trimesh.creation.icosphere(subdivisions=_SUBDIVISIONS)
    unit, faces = torch.from_numpy(ball.vertices).float(), torch.from_numpy(ball.faces).long()
    axes = matrix_from_quaternion(gaussians.rotations) * (_DEVIATIONS * gaussians.scales)[:, None]
    vertices = torch.einsum("nij,vj->nvi", axes, unit) + gaussians.means[:, None]
    first = torch.arange(len(gaussians)) * len(unit)
    return Shape("gaussians", vertices.flatten(0, 1), (faces + first[:, None, None]).flatten(0, 1))


def rasterize_shapes(shapes: Sequence[Shape], camera: Camera) -> Hits:
    """Return what a camera sees by our own projection."""
    firsts = np.cumsum([0, *(len(shape.vertices) for shape in shapes)])
    faces = torch.cat([shape.faces + int(first) for shape, first in zip(shapes, firsts, strict=False)])
    view = rasterize_mesh(torch.cat([shape.vertices for shape in shapes]), faces, camera)
    owner = torch.cat([torch.full((len(shape.faces),), index) for index, shape in enumerate(shapes)])
    indices = torch.where(view.faces >= 0, owner[view.faces.clamp_min(0)], -1)
    return Hits(indices, view.depth)


class MitsubaScene:
    """Shapes as Mitsuba holds them."""

    def __init__(self, mi: Any, shapes: Sequence[Shape]) -> None:
        self._mi = mi
        self._shapes = [_mesh(mi, shape) for shape in shapes]
        self._scene = mi.load_dict(
            {"type": "scene"} | {shape.name: mesh for shape, mesh in zip(shapes, self._shapes, strict=True)}
        )

    def trace(self, camera: Camera) -> Hits:
        """Return what Mitsuba sees through a camera."""
        sensor = self._mi.load_dict(make_sensor(self._mi, square_pixels(camera)[0]))
        intersect = self._intersect_scalar if self._mi.variant().startswith("scalar") else self._intersect
        points, shapes = intersect(sensor, pixel_centers(camera))
        transform = camera.T_camera_world.double().numpy()
        depth = points @ transform[2, :3] + transform[2, 3]
        size = camera.height, camera.width
        depth[shapes < 0] = np.inf
        return Hits(torch.from_numpy(shapes).view(size), torch.from_numpy(depth).float().view(size))

    def _intersect(self, sensor: Any, film: Float[np.ndarray, "p 2"]) -> tuple[np.ndarray, np.ndarray]:
        """Return where rays through places on the film end (world metres), and at which shape."""
        mi = self._mi
        x, y = (mi.Float(np.ascontiguousarray(film[:, axis], np.float32)) for axis in (0, 1))
        rays, _ = sensor.sample_ray(mi.Float(0), mi.Float(0), mi.Point2f(x, y), mi.Point2f(0.5))
        hits = self._scene.ray_intersect(rays)
        shapes = np.full(len(film), -1)
        for index, mesh in enumerate(self._shapes):
            shapes[np.array(hits.shape == mi.ShapePtr(mesh))] = index
        return np.array(hits.p, np.float64).T, shapes

    def _intersect_scalar(self, sensor: Any, film: Float[np.ndarray, "p 2"]) -> tuple[np.ndarray, np.ndarray]:
        mi, middle = self._mi, self._mi.ScalarPoint2f(0.5)
        points, shapes = np.zeros((len(film), 3)), np.full(len(film), -1)
        for index, position in enumerate(film.tolist()):
            ray, _ = sensor.sample_ray(0.0, 0.0, mi.ScalarPoint2f(*position), middle)
            hit = self._scene.ray_intersect(ray)
            if hit.is_valid():
                points[index], shapes[index] = np.array(hit.p), self._shapes.index(hit.shape)
        return points, shapes


def compare(ours: Hits, theirs: Hits) -> Agreement:
    """Return how well they agree."""
    both, either = ours.hit & theirs.hit, ours.hit | theirs.hit
    return Agreement(
        iou=float(both.sum() / either.sum()) if either.any() else float("nan"),
        depth_mae=float((ours.depth - theirs.depth)[both].abs().mean()),
        shapes=float((ours.shapes == theirs.shapes)[both].float().mean()),
    )


def _mesh(mi: Any, shape: Shape) -> Any:
    mesh = mi.Mesh(shape.name, len(shape.vertices), len(shape.faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = shape.vertices.numpy().astype(np.float32).ravel()
    parameters["faces"] = shape.faces.numpy().astype(np.uint32).ravel()
    parameters.update()
    return mesh
