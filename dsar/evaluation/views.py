"""True and predicted images as they are compared: over white, display-referred sRGB in [0, 1]."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from dsar.raster import rasterize
from dsar.types import Camera, Capture, Gaussians

WHITE = torch.ones(3)


@dataclass(frozen=True)
class View:
    """One image of the truth over white."""

    color: Float[Tensor, "h w 3"]
    """sRGB over white."""
    mask: Float[Tensor, "h w"]
    """Alpha of the truth."""


def true_view(
    capture: Capture, sequence: str, frame: int, camera: int, device: torch.device | None = None
) -> View:
    """Return a true image over white, on the device of what it is compared with (None: the CPU)."""
    pixels = torch.tensor(capture.image(sequence, frame, camera), device=device).float() / 255
    alpha = pixels[..., 3]
    return View(pixels[..., :3] * alpha[..., None] + (1 - alpha[..., None]), alpha)


def render_white(gaussians: Gaussians, camera: Camera) -> Float[Tensor, "h w 3"]:
    """Return an image over white."""
    return rasterize(gaussians, camera, background=WHITE.to(gaussians.means)).color


def to_bytes(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image as 8-bit numbers."""
    return (image.clamp(0, 1) * 255).round().byte().cpu().numpy()
