"""The losses of rendered views against their images."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.config import LossConfig
from dsar.devices import send, takes_kernels
from dsar.training.fused_loss import fused_image_loss
from dsar.training.padded_images import Padding, padded_losses
from dsar.training.targets import Target
from dsar.types import RenderOutput


def image_losses(
    images: Sequence[RenderOutput],
    targets: Sequence[Target],
    backgrounds: Float[Tensor, "v 3"],
    config: LossConfig,
    lpips: torch.nn.Module | None,
) -> tuple[Float[Tensor, " v"], Float[Tensor, " v"]]:
    """Return L_render of each view over its background (paper equation 23), and its mean squared error.

    L_rgb is taken over a pyramid, and the difference of alpha and mask is added.

    Args:
        images: At least one, drawn over the backgrounds.
        targets: What they should be, in main memory.
        backgrounds: Where the images are.
        config: Weights of the losses.
        lpips: The network of LPIPS, where it is used.
    """
    fused = images[0].color.dtype == torch.float32 and takes_kernels(images[0].color)
    compare = _compare_one_by_one if fused else _compare_together
    losses, errors, truths = compare(images, targets, backgrounds, config)
    if lpips is not None:
        distances = [_perceptual(i.color, truth, lpips) for i, truth in zip(images, truths, strict=True)]
        losses = losses + config.lpips * torch.stack(distances)
    return losses, errors


_Compared = tuple[Float[Tensor, " v"], Float[Tensor, " v"], list[Float[Tensor, "_ _ 3"]]]
"""Losses without LPIPS, squared errors, and the truths over their backgrounds."""


def _compare_one_by_one(
    images: Sequence[RenderOutput], targets: Sequence[Target], backgrounds: Tensor, config: LossConfig
) -> _Compared:
    weights, losses, errors, truths = (config.l1, config.ssim, config.alpha), [], [], []
    for image, target, background in zip(images, targets, backgrounds, strict=True):
        truth = target.color + (1 - target.alpha[..., None]) * background
        losses.append(
            fused_image_loss(image.color, image.alpha, truth, target.alpha, config.pyramid, weights)
        )
        errors.append((image.color - truth).detach().square().mean())
        truths.append(truth)
    return torch.stack(losses), torch.stack(errors), truths


def _compare_together(
    images: Sequence[RenderOutput], targets: Sequence[Target], backgrounds: Tensor, config: LossConfig
) -> _Compared:
    sizes = [(target.alpha.shape[0], target.alpha.shape[1]) for target in targets]
    padding = Padding.of(sizes, config.pyramid, backgrounds.device)
    drawn = [torch.cat([image.color.flatten(0, 1) for image in images])]
    drawn.append(torch.cat([image.alpha.flatten() for image in images])[:, None])
    colors = padding.pad(torch.cat(drawn, 1))
    # Sent at once: a copy has a price, whatever its size.
    seen = torch.cat([torch.cat([t.color, t.alpha[..., None]], 2).flatten(0, 1) for t in targets])
    truths = padding.pad(send(seen.to(colors.dtype), colors.device))
    free = padding.inside(colors) - truths[:, 3:]
    truths = torch.cat([truths[:, :3] + free * backgrounds[:, :, None, None], truths[:, 3:]], 1)
    weights = config.l1, config.ssim, config.alpha
    losses, errors = padded_losses(colors, truths, padding, config.pyramid, weights)
    cut = [image[:3, :h, :w].permute(1, 2, 0) for image, (h, w) in zip(truths, sizes, strict=True)]
    return losses, errors, cut


def _perceptual(
    color: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], lpips: torch.nn.Module
) -> Float[Tensor, ""]:
    return lpips(*(image.permute(2, 0, 1)[None].clamp(0, 1) for image in (color, truth))).mean()
