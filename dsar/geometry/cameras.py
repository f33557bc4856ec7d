"""Projection, and the one place where camera conventions are converted.

Ours is OpenCV: x right, y down, z forward; pixel (0, 0) has its centre at (0.5, 0.5).
OpenGL and USD: x right, y up, looking along -z. Mitsuba: x left, y up, looking along +z.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.types import Camera

# Diagonal that turns OpenCV camera axes into the named convention's axes.
_AXES = {"opencv": (1.0, 1.0, 1.0), "opengl": (1.0, -1.0, -1.0), "mitsuba": (-1.0, -1.0, 1.0)}


def project(
    camera: Camera, points: Float[Tensor, "*b 3"]
) -> tuple[Float[Tensor, "*b 2"], Float[Tensor, " *b"]]:
    """Return pixel coordinates (x, y) and camera-space depth in metres of world points."""
    transform = camera.T_camera_world.to(points)
    local = points @ transform[:3, :3].T + transform[:3, 3]
    homogeneous = local @ camera.K.to(points).T
    return homogeneous[..., :2] / homogeneous[..., 2:], local[..., 2]


def unproject(
    camera: Camera, pixels: Float[Tensor, "*b 2"], depth: Float[Tensor, " *b"]
) -> Float[Tensor, "*b 3"]:
    """Return world points of pixel coordinates at a camera-space depth in metres."""
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1)
    local = homogeneous @ torch.linalg.inv(camera.K.to(pixels)).T * depth[..., None]
    transform = camera.T_camera_world.to(pixels)
    return (local - transform[:3, 3]) @ transform[:3, :3]


def farthest_cameras(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """Return some cameras in their order: the first, and others as far from those chosen as can be."""
    transforms = torch.stack([camera.T_camera_world for camera in cameras])
    centers = -(transforms[:, :3, :3].mT @ transforms[:, :3, 3:])[..., 0]
    chosen = [0]
    while len(chosen) < count:
        nearest = torch.cdist(centers, centers[chosen]).amin(1)
        nearest[chosen] = -1.0
        chosen.append(int(nearest.argmax()))
    return [cameras[i] for i in sorted(chosen)]


def look_at(position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float[Tensor, "4 4"]:
    """Return T_camera_world of an upright camera at `position` that looks at `target` (world metres)."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, -rotation @ position
    return torch.from_numpy(transform).float()


def world_from_camera(
    camera: Camera, convention: Literal["opencv", "opengl", "mitsuba"]
) -> Float[np.ndarray, "4 4"]:
    """Return the camera-to-world matrix (column vectors, float64) in a convention's camera axes."""
    transform = camera.T_camera_world.double().numpy()
    rotation = transform[:3, :3].T
    result = np.eye(4)
    result[:3, :3] = rotation * np.array(_AXES[convention])
    result[:3, 3] = -rotation @ transform[:3, 3]
    return result
