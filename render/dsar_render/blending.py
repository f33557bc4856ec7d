"""Values of Gaussians as images: blended as colours are."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.geometry.harmonics import C0
from dsar.raster import rasterize
from dsar.types import Camera, Gaussians

_CHANNELS = 3


def blend_values(
    gaussians: Gaussians, camera: Camera, values: Float[Tensor, "n c"]
) -> Float[Tensor, "h w c"]:
    """Return the sum of each pixel's Gaussians' values, weighted by their shares of the pixel.

    They are drawn three at a time as colours that look the same from everywhere, so that whatever draws
    colours draws them, in exactly their weights.
    """
    # What is not finite is not drawn; it must not reach the others through the lowest value.
    values = torch.where(values.isfinite(), values, 0.0)
    lowest = values.amin(0) if len(values) else values.new_zeros(values.shape[1])
    # Colours are clamped at 0.
    raised = values - lowest
    sums = []
    for first in range(0, values.shape[1], _CHANNELS):
        chosen = raised[:, first : first + _CHANNELS]
        colors = torch.nn.functional.pad(chosen, (0, _CHANNELS - chosen.shape[1]))
        painted = dataclasses.replace(gaussians, harmonics=((colors - 0.5) / C0)[:, None])
        output = rasterize(painted, camera)
        offset = lowest[first : first + _CHANNELS] * output.alpha[..., None]
        sums.append(output.color[..., : chosen.shape[1]] + offset)
    return torch.cat(sums, -1)
