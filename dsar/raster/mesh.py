"""Triangle meshes in an image: which triangle each pixel sees. For overlays and scans; no gradients."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from dsar.geometry.cameras import project
from dsar.raster.jit import kernel
from dsar.types import Camera

NEAR = 0.01
"""Metres in front of the camera from which triangles are drawn; those that cross it are left out."""


@dataclass(frozen=True)
class MeshView:
    """What the centre of each pixel sees of a mesh."""

    faces: Int64[Tensor, "h w"]
    """The nearest triangle, from either side; -1 where there is none."""
    weights: Float[Tensor, "h w 3"]
    """The barycentric weights of its corners there, true to perspective."""
    depth: Float[Tensor, "h w"]
    """Camera-space depth in metres; infinite where there is nothing."""


def rasterize_mesh(vertices: Float[Tensor, "v 3"], faces: Int64[Tensor, "f 3"], camera: Camera) -> MeshView:
    """Return what a camera sees of a mesh in world metres."""
    pixels, depth = project(camera, vertices.double())
    face_ids, weights, z_buffer = _fill_triangles(
        pixels.numpy(), depth.numpy(), faces.numpy(), camera.width, camera.height, NEAR
    )
    return MeshView(torch.from_numpy(face_ids), torch.from_numpy(weights), torch.from_numpy(z_buffer))


@kernel
def _fill_triangles(pixels, depth, faces, width, height, near):
    """Return triangle, weights and depth of every pixel (`pixels` are corners' places in the image)."""
    face_ids = np.full((height, width), -1, np.int64)
    weights = np.zeros((height, width, 3), np.float32)
    z_buffer = np.full((height, width), np.inf, np.float32)
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        za, zb, zc = depth[a], depth[b], depth[c]
        if min(za, zb, zc) < near:
            continue
        ax, ay, bx, by = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1]
        cx, cy = pixels[c, 0], pixels[c, 1]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0:
            continue
        left, right = max(int(min(ax, bx, cx)), 0), min(int(max(ax, bx, cx)), width - 1)
        top, bottom = max(int(min(ay, by, cy)), 0), min(int(max(ay, by, cy)), height - 1)
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                u = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / area
                v = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / area
                w = 1 - u - v
                if u < 0 or v < 0 or w < 0:
                    continue
                z = 1 / (u / za + v / zb + w / zc)
                if z < z_buffer[row, column]:
                    z_buffer[row, column], face_ids[row, column] = z, face
                    weights[row, column, 0] = u / za * z
                    weights[row, column, 1] = v / zb * z
                    weights[row, column, 2] = w / zc * z
    return face_ids, weights, z_buffer
