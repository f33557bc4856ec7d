"""The images that training compares with: decoded, premultiplied, reduced and cropped to the person."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from dsar.types import Camera, Capture

MARGIN = 6
"""Pixels kept around the person."""


@dataclass(frozen=True)
class Target:
    """One view to be matched."""

    color: Float[Tensor, "h w 3"]
    """Display-referred sRGB in [0, 1], premultiplied by alpha."""
    alpha: Float[Tensor, "h w"]
    """The mask in [0, 1]."""
    camera: Camera
    """The camera of exactly these pixels."""


def load_target(capture: Capture, sequence: str, frame: int, camera_index: int, reduction: int) -> Target:
    """Return a view at 1/reduction of its size, cropped to the mask with a margin.

    Premultiplied pixels are averaged, so that the mask's border stays right.
    """
    pixels, camera = capture.image(sequence, frame, camera_index), capture.cameras[camera_index]
    x0, y0, x1, y1 = (edge // reduction for edge in mask_box(pixels[..., 3], MARGIN * reduction))
    x1, y1 = max(x1, x0 + 1), max(y1, y0 + 1)
    inside = slice(y0 * reduction, y1 * reduction), slice(x0 * reduction, x1 * reduction)
    image = torch.from_numpy(pixels[inside].copy()).permute(2, 0, 1).float() / 255
    image = torch.cat([image[:3] * image[3:], image[3:]])
    if reduction > 1:
        image = torch.nn.functional.avg_pool2d(image, reduction)
        width, height = camera.width // reduction, camera.height // reduction
        whole = dataclasses.replace(camera, width=width * reduction, height=height * reduction)
        camera = whole.resized(width, height)
    color, alpha = image[:3].permute(1, 2, 0).contiguous(), image[3].contiguous()
    return Target(color, alpha, camera.cropped(x0, y0, x1 - x0, y1 - y0))


def mask_box(alpha: Shaped[np.ndarray, "h w"], margin: int) -> tuple[int, int, int, int]:
    """Return (x0, y0, x1, y1) of what is not transparent, with a margin; the whole image if nothing is."""
    h, w = alpha.shape
    rows, columns = np.flatnonzero(alpha.any(1)), np.flatnonzero(alpha.any(0))
    if not len(rows):
        return 0, 0, w, h
    x0, x1 = max(int(columns[0]) - margin, 0), min(int(columns[-1]) + 1 + margin, w)
    y0, y1 = max(int(rows[0]) - margin, 0), min(int(rows[-1]) + 1 + margin, h)
    return x0, y0, x1, y1
