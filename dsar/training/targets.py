"""The images that training compares with: decoded, premultiplied, reduced and cropped to the person."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
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
    pixels = capture.image(sequence, frame, camera_index).astype(np.float32) / 255
    alpha = pixels[..., 3:]
    image = np.concatenate([pixels[..., :3] * alpha, alpha], -1)
    camera = capture.cameras[camera_index]
    if reduction > 1:
        h, w = (size // reduction * reduction for size in image.shape[:2])
        blocks = image[:h, :w].reshape(h // reduction, reduction, w // reduction, reduction, 4)
        image = blocks.mean((1, 3))
        camera = dataclasses.replace(camera, width=w, height=h).resized(w // reduction, h // reduction)
    x0, y0, x1, y1 = mask_box(image[..., 3], MARGIN)
    crop = torch.from_numpy(np.ascontiguousarray(image[y0:y1, x0:x1]))
    return Target(crop[..., :3], crop[..., 3], camera.cropped(x0, y0, x1 - x0, y1 - y0))


def mask_box(alpha: Float[np.ndarray, "h w"], margin: int) -> tuple[int, int, int, int]:
    """Return (x0, y0, x1, y1) of the mask's bounding box with a margin; the whole image if it is empty."""
    h, w = alpha.shape
    rows, columns = np.flatnonzero(alpha.max(1) > 0.02), np.flatnonzero(alpha.max(0) > 0.02)
    if not len(rows):
        return 0, 0, w, h
    x0, x1 = max(int(columns[0]) - margin, 0), min(int(columns[-1]) + 1 + margin, w)
    y0, y1 = max(int(rows[0]) - margin, 0), min(int(rows[-1]) + 1 + margin, h)
    return x0, y0, x1, y1
