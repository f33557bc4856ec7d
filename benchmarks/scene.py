"""What the rasteriser benchmark draws: a body-like shell of Gaussians and the camera before it."""

import math

import numpy as np
import torch

from dsar.geometry.cameras import look_at
from dsar.types import Camera, Gaussians


def make_body(count: int) -> Gaussians:
    """Return flat Gaussians on a standing capsule, 70 % nearly opaque, as large as covers it."""
    generator = torch.Generator().manual_seed(0)
    angle, height, kind = torch.rand(3, count, generator=generator)
    angle, height = 2 * math.pi * angle, 1.8 * height
    radius = 0.25 + 0.05 * torch.sin(3 * height)
    spacing = (2 * math.pi * 0.25 * 1.8 / count) ** 0.5
    scales = 0.75 * spacing * (0.6 + 0.8 * torch.rand(count, 3, generator=generator))
    return Gaussians(
        torch.stack([radius * angle.cos(), height, radius * angle.sin()], -1),
        torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1),
        scales * torch.tensor([0.2, 1.0, 1.0]),
        torch.where(kind < 0.7, 0.95, 0.4),
        torch.randn(count, 1, 3, generator=generator) * 0.5,
    )


def make_camera(width: int, height: int) -> Camera:
    """Return a camera 3 m away whose image the body fills to 85 % of its height."""
    focal = 0.85 * height / 1.8 * 3
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(K, look_at(np.array([0.0, 1.0, 3.0]), np.array([0.0, 0.9, 0.0])), width, height, "front")


def make_image_gradient(camera: Camera) -> torch.Tensor:
    """Return the upstream gradient [h, w, 3] of the colour image, the same for every rasteriser."""
    return torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1))
