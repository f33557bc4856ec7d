"""The images that training compares with: decoded, premultiplied, reduced and cropped to the person."""

import dataclasses
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.metrics.images import with_margin
from dsar.training.kept_views import KeptViews
from dsar.types import Camera

MARGIN = 6
"""Pixels kept around the person."""


@dataclass(frozen=True)
class Target:
    """One view to be matched, in main memory."""

    color: Float[Tensor, "h w 3"]
    """Display-referred sRGB in [0, 1], premultiplied by alpha."""
    alpha: Float[Tensor, "h w"]
    """The mask in [0, 1]."""
    camera: Camera
    """The camera of exactly these pixels."""


def load_target(views: KeptViews, sequence: str, frame: int, camera_index: int, reduction: int) -> Target:
    """Return a view at 1/reduction of its size, cropped to the mask with a margin.

    Premultiplied pixels are averaged, so that the mask's border stays right.
    """
    view, camera = views.read(sequence, frame, camera_index), views.capture.cameras[camera_index]
    box = with_margin(view.box, MARGIN * reduction, camera.width, camera.height)
    if reduction > 1:
        width, height = camera.width // reduction, camera.height // reduction
        whole = dataclasses.replace(camera, width=width * reduction, height=height * reduction)
        camera = whole.resized(width, height)
    x0, y0, x1, y1 = (edge // reduction for edge in box)
    x1, y1 = min(max(x1, x0 + 1), camera.width), min(max(y1, y0 + 1), camera.height)
    color, alpha = view.premultiplied_means(x0, y0, x1, y1, reduction)
    camera = camera.cropped(x0, y0, x1 - x0, y1 - y0)
    return Target(torch.from_numpy(color), torch.from_numpy(alpha), camera)


class TargetLoader:
    """Loads views in threads of its own, while the network computes."""

    def __init__(self, views: KeptViews, threads: int = 1) -> None:
        self.views = views
        self._threads = ThreadPoolExecutor(threads, "targets")

    def request(
        self, rng: np.random.Generator, sequence: str, frame: int, reduction: int, count: int
    ) -> list[Future[Target]]:
        """Begin to load some of the views of a frame, as many as there are at most."""
        cameras = self.views.capture.cameras_with_image(sequence, frame)
        chosen = rng.choice(cameras, min(count, len(cameras)), replace=False) if cameras else ()
        submit = self._threads.submit
        return [submit(load_target, self.views, sequence, frame, int(k), reduction) for k in chosen]
