"""The images that training compares with: decoded, premultiplied, reduced and cropped to the person."""

import dataclasses
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.metrics.images import mask_box
from dsar.raster.jit import kernel
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
    if reduction > 1:
        width, height = camera.width // reduction, camera.height // reduction
        whole = dataclasses.replace(camera, width=width * reduction, height=height * reduction)
        camera = whole.resized(width, height)
    x0, y0, x1, y1 = (edge // reduction for edge in mask_box(pixels[..., 3], MARGIN * reduction))
    x1, y1 = min(max(x1, x0 + 1), camera.width), min(max(y1, y0 + 1), camera.height)
    color, alpha = _premultiplied_means(pixels, x0, y0, x1, y1, reduction)
    camera = camera.cropped(x0, y0, x1 - x0, y1 - y0)
    return Target(torch.from_numpy(color), torch.from_numpy(alpha), camera)


class TargetLoader:
    """Loads views in threads of its own, while the network computes."""

    def __init__(self, capture: Capture, threads: int = 1) -> None:
        self.capture = capture
        self._threads = ThreadPoolExecutor(threads, "targets")

    def request(
        self, rng: np.random.Generator, sequence: str, frame: int, reduction: int, count: int
    ) -> list[Future[Target]]:
        """Begin to load some of the views of a frame, as many as there are at most."""
        cameras = self.capture.cameras_with_image(sequence, frame)
        chosen = rng.choice(cameras, min(count, len(cameras)), replace=False) if cameras else ()
        return [
            self._threads.submit(load_target, self.capture, sequence, frame, int(index), reduction)
            for index in chosen
        ]


@kernel
def _premultiplied_means(pixels, x0, y0, x1, y1, n):
    """Return colour times alpha and alpha, averaged over n x n pixels, of the blocks x0..x1-1, y0..y1-1."""
    color, alpha = np.empty((y1 - y0, x1 - x0, 3), np.float32), np.empty((y1 - y0, x1 - x0), np.float32)
    per_alpha = np.float32(1 / (255 * n * n))
    per_color = np.float32(1 / (255 * 255 * n * n))
    for y in range(y0, y1):
        for x in range(x0, x1):
            red, green, blue, cover = 0, 0, 0, 0
            for row in range(y * n, y * n + n):
                for column in range(x * n, x * n + n):
                    a = np.int64(pixels[row, column, 3])
                    red += a * pixels[row, column, 0]
                    green += a * pixels[row, column, 1]
                    blue += a * pixels[row, column, 2]
                    cover += a
            out = color[y - y0, x - x0]
            out[0], out[1], out[2] = red * per_color, green * per_color, blue * per_color
            alpha[y - y0, x - x0] = cover * per_alpha
    return color, alpha
