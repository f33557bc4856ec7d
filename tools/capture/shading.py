"""Soft light and camera rays over one triangle mesh, traced with Mitsuba (LLVM back end).

Cloth and skin are diffuse, so light is gathered once a frame at the vertices (it does not depend on the
view) from a fixed set of directions, and each view only has to look up what its pixels see. All views of
a frame therefore agree, and nothing is noisy. World: metres, Y up; colours linear.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from dsar.types import Camera

mi.set_variant("llvm_ad_rgb")

SAMPLES = 4
"""Rays along each side of a pixel."""
_OFFSET = 0.004


@dataclass(frozen=True)
class Lighting:
    """Directions towards the light and the irradiance that each gives to a surface facing it."""

    directions: Float[ndarray, "l 3"]
    irradiance: Float[ndarray, "l 3"]


def studio_lighting() -> Lighting:
    """Return a bright dome, a large soft key from the front left and a rim from behind."""
    sphere = _fibonacci(44, 1.0, np.array([0.0, 1.0, 0.0]))
    up = 0.5 + 0.5 * sphere[:, 1:2]
    dome = (np.array([0.40, 0.35, 0.31]) * (1 - up) + np.array([0.78, 0.82, 0.90]) * up) * 4 / len(sphere)
    key = _fibonacci(14, 0.075, np.array([0.62, 0.72, 0.62]))
    rim = _fibonacci(7, 0.05, np.array([-0.70, 0.55, -0.75]))
    return Lighting(
        np.concatenate([sphere, key, rim]),
        np.concatenate(
            [
                dome,
                np.tile(np.array([1.02, 0.96, 0.88]) / len(key), (len(key), 1)),
                np.tile(np.array([0.50, 0.54, 0.62]) / len(rim), (len(rim), 1)),
            ]
        ),
    )


def _fibonacci(count: int, share: float, axis: Float[ndarray, "3"]) -> Float[ndarray, "n 3"]:
    """Return directions spread evenly over the cap about an axis that is a share of the sphere."""
    k = np.arange(count) + 0.5
    cosine = 1 - 2 * share * k / count
    turn = np.pi * (1 + 5**0.5) * k
    axis = axis / np.linalg.norm(axis)
    side = np.cross(axis, [0.36, 0.48, 0.80])
    side /= np.linalg.norm(side)
    sine = np.sqrt(1 - cosine**2)[:, None]
    return cosine[:, None] * axis + sine * (
        np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side)
    )


class Stage:
    """A mesh of fixed topology whose vertices move; it is lit and seen frame by frame."""

    def __init__(self, faces: Int[ndarray, "t 3"], albedo: Float[ndarray, "n 3"], lighting: Lighting) -> None:
        """Build the scene once, with all vertices at the origin until `move`."""
        mesh = mi.Mesh("stage", len(albedo), len(faces))
        params = mi.traverse(mesh)
        # A degenerate mesh has no bounding box: start from a spread of points.
        params["vertex_positions"] = np.linspace(-1, 1, albedo.size).astype(np.float32)
        params["faces"] = faces.astype(np.uint32).ravel()
        params.update()
        self._scene = mi.load_dict({"type": "scene", "stage": mesh})
        self._params = mi.traverse(self._scene)
        self._faces = mi.UInt32(faces.astype(np.uint32).ravel())
        self._albedo = mi.Float(albedo.astype(np.float32).ravel())
        self._directions = mi.Float(lighting.directions.astype(np.float32).ravel())
        self._irradiance = mi.Float(lighting.irradiance.astype(np.float32).ravel())
        self._count = len(lighting.directions)

    def move(self, vertices: Float[ndarray, "n 3"]) -> None:
        """Set the vertices, world metres, and rebuild the ray-tracing structure."""
        self._vertices = vertices
        self._positions = mi.Float(vertices.astype(np.float32).ravel())
        self._params["stage.vertex_positions"] = self._positions
        self._params.update()

    def light(self, points: Float[ndarray, "p 3"], normals: Float[ndarray, "p 3"]) -> Float[ndarray, "p 3"]:
        """Return what a white diffuse surface reflects at points with unit normals."""
        total = _gather_light(
            self._scene,
            mi.Point3f(*(mi.Float(np.ascontiguousarray(points[:, k], np.float32)) for k in range(3))),
            mi.Normal3f(*(mi.Float(np.ascontiguousarray(normals[:, k], np.float32)) for k in range(3))),
            self._directions,
            self._irradiance,
            mi.UInt32(self._count),
        )
        return np.array(total).T

    def shine(self, front: Float[ndarray, "n 3"], back: Float[ndarray, "n 3"]) -> None:
        """Set the light that white reflects at each vertex: on the triangles' outside, and on the inside."""
        self._lit = [mi.Float(side.astype(np.float32).ravel()) for side in (front, back)]

    def view(self, camera: Camera) -> UInt8[ndarray, "h w 4"]:
        """Return the image of a camera (any pinhole): straight sRGB, coverage as alpha."""
        x0, y0, x1, y1 = self._bounds(camera)
        color, alpha = self._trace(camera, (x0, y0, x1 - x0, y1 - y0))
        image = np.zeros((camera.height, camera.width, 4), np.uint8)
        straight = np.clip(color / np.maximum(alpha, 1e-6)[..., None], 0, 1)
        display = np.where(straight <= 0.0031308, 12.92 * straight, 1.055 * straight ** (1 / 2.4) - 0.055)
        rgba = np.concatenate([display * (alpha[..., None] > 0), alpha[..., None]], -1)
        image[y0:y1, x0:x1] = np.round(255 * rgba)
        return image

    def _bounds(self, camera: Camera) -> tuple[int, int, int, int]:
        transform = camera.T_camera_world.double().numpy()
        # Every eighth vertex and two pixels more bound them all: neighbours are a centimetre apart.
        local = (self._vertices[::8] @ transform[:3, :3].T + transform[:3, 3]) @ camera.K.double().numpy().T
        pixels = local[:, :2] / local[:, 2:]
        low = np.clip(np.floor(pixels.min(0)) - 2, 0, [camera.width - 1, camera.height - 1]).astype(int)
        high = np.clip(np.ceil(pixels.max(0)) + 2, low + 1, [camera.width, camera.height]).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def _trace(
        self, camera: Camera, window: tuple[int, int, int, int]
    ) -> tuple[Float[ndarray, "h w 3"], Float[ndarray, "h w"]]:
        x0, y0, width, height = window
        rays = SAMPLES * SAMPLES
        columns = dr.opaque(mi.UInt32, width)
        index = dr.arange(mi.UInt32, width * height * rays)
        pixel, sample = index // rays, index % rays
        px = mi.Float(pixel % columns) + _opaque(x0) + (mi.Float(sample % SAMPLES) + 0.5) / SAMPLES
        py = mi.Float(pixel // columns) + _opaque(y0) + (mi.Float(sample // SAMPLES) + 0.5) / SAMPLES
        transform = camera.T_camera_world.double().numpy()
        unproject = transform[:3, :3].T @ np.linalg.inv(camera.K.double().numpy())
        direction = mi.Vector3f(*(_opaque(a) * px + _opaque(b) * py + _opaque(c) for a, b, c in unproject))
        origin = mi.Point3f(*(_opaque(v) for v in -transform[:3, :3].T @ transform[:3, 3]))
        hit = self._scene.ray_intersect_preliminary(mi.Ray3f(origin, dr.normalize(direction)), coherent=True)
        found = hit.is_valid()
        corner = [dr.gather(mi.UInt32, self._faces, 3 * hit.prim_index + k, found) for k in range(3)]
        share = (1 - hit.prim_uv.x - hit.prim_uv.y, hit.prim_uv.x, hit.prim_uv.y)
        spot = [dr.gather(mi.Point3f, self._positions, c, found) for c in corner]
        outside = dr.dot(direction, mi.Vector3f(dr.cross(spot[1] - spot[0], spot[2] - spot[0]))) < 0
        color = mi.Color3f(0)
        for c, w in zip(corner, share, strict=True):
            albedo = dr.gather(mi.Color3f, self._albedo, c, found)
            light = [dr.gather(mi.Color3f, side, c, found) for side in self._lit]
            color += w * albedo * dr.select(outside, light[0], light[1])
        channels = [dr.select(found, v, 0) for v in (*color, mi.Float(1))]
        # One kernel for all channels: each block sum would otherwise trace the rays again.
        dr.eval(channels)
        sums = [dr.block_sum(v, rays) for v in channels]
        result = np.stack([np.array(v) for v in sums], -1).reshape(height, width, 4) / rays
        return result[..., :3], result[..., 3]


def _opaque(value: float) -> mi.Float:
    """Return a number that is an argument of the compiled kernel instead of a part of its text."""
    return dr.opaque(mi.Float, float(value))


@dr.syntax
def _gather_light(scene, point, normal, directions, irradiance, count):
    """Return the light that reaches points past everything in the scene, one ray a direction."""
    total = mi.Color3f(0)
    k = mi.UInt32(0)
    origin = point + normal * _OFFSET
    while k < count:
        towards = dr.gather(mi.Vector3f, directions, k)
        cosine = dr.dot(normal, towards)
        facing = cosine > 0.02
        blocked = scene.ray_test(mi.Ray3f(origin, towards), active=facing)
        total += dr.select(facing & ~blocked, cosine, 0) * dr.gather(mi.Color3f, irradiance, k)
        k += 1
    return total
