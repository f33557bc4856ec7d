"""Losses of one frame: against the image, between neighbours on the surface, against a registered map."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from dsar.config import LossConfig
from dsar.devices import takes_kernels
from dsar.metrics.images import ssim
from dsar.training.fused_loss import fused_image_loss
from dsar.training.targets import Target
from dsar.types import RenderOutput

CENTIMETRES = 100.0
_KNEE = 0.5
"""Centimetres below which a distance is squared after all, to be smooth."""


def pyramid_l1(
    image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], levels: int
) -> Float[Tensor, ""]:
    """Return the mean absolute difference, averaged over levels that halve the resolution.

    Coarse levels pull a garment towards a place it does not overlap yet.
    """
    difference = (image - target).permute(2, 0, 1)[None]
    total = difference.abs().mean()
    for _ in range(levels - 1):
        difference = torch.nn.functional.avg_pool2d(difference, 2, ceil_mode=True, count_include_pad=False)
        total = total + difference.abs().mean()
    return total / levels


def plain_image_loss(
    color: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    truth: Float[Tensor, "h w 3"],
    mask: Float[Tensor, "h w"],
    levels: int,
    weights: tuple[float, float, float],
) -> Float[Tensor, ""]:
    """Return the weighted sum of pyramid L1, 1 - SSIM, and the mean absolute difference of alpha and mask."""
    l1, similarity, cover = weights
    loss = l1 * pyramid_l1(color, truth, levels) + cover * (alpha - mask).abs().mean()
    return loss + similarity * (1 - ssim(color, truth)) if similarity else loss


def image_loss(
    output: RenderOutput,
    target: Target,
    background: Float[Tensor, "3"],
    config: LossConfig,
    lpips: torch.nn.Module | None,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return L_render of one view over a background (paper equation 23), and its mean squared error.

    L_rgb is taken over a pyramid, and the difference of alpha and mask is added.
    """
    truth = target.color + (1 - target.alpha[..., None]) * background
    fused = truth.dtype == torch.float32 and takes_kernels(truth)
    compare = fused_image_loss if fused else plain_image_loss
    weights = (config.l1, config.ssim, config.alpha)
    loss = compare(output.color, output.alpha, truth, target.alpha, config.pyramid, weights)
    if lpips is not None:
        pair = [image.permute(2, 0, 1)[None].clamp(0, 1) for image in (output.color, truth)]
        loss = loss + config.lpips * lpips(*pair).mean()
    return loss, (output.color - truth).detach().square().mean()


def spatial_loss(offsets: Float[Tensor, "b p 3"], edges: Int64[Tensor, "l 2"]) -> Float[Tensor, ""]:
    """Return the mean squared difference, in cm, of the offsets of neighbouring points; 0 without edges."""
    if not len(edges):
        return offsets.new_zeros(())
    change = (offsets[:, edges[:, 0]] - offsets[:, edges[:, 1]]) * CENTIMETRES
    return change.square().sum(2).mean()


def registered_loss(
    offsets: Float[Tensor, "b p 3"], registered: Float[Tensor, "b p 3"]
) -> Float[Tensor, " b"]:
    """Return the mean distance, in cm, of the control points' offsets to registered ones.

    Not squared: at rest the last millimetres count, in a spin the map itself is centimetres off.
    """
    error = (offsets - registered) * CENTIMETRES
    return ((error.square().sum(2) + _KNEE**2).sqrt() - _KNEE).mean(1)
