"""Our own backends, called like their rivals."""

from typing import Literal

import torch

from dsar.raster import rasterize
from dsar.types import Camera, Gaussians
from rivals import TorchScene


def prepare(
    gaussians: Gaussians, camera: Camera, threads: int, backend: Literal["cpu", "reference"]
) -> TorchScene:
    """Return the scene as one of our backends draws it."""

    def render(gaussians: Gaussians, camera: Camera) -> torch.Tensor:
        return rasterize(gaussians, camera, backend=backend).color

    return TorchScene(render, gaussians, camera)
