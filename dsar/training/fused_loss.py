"""The image losses of `padded_images.py`, of one image, value and gradient together in compiled loops.

A training image is so small that as tensor operations its losses cost as much as rendering it. The plain
function in `padded_images.py` says what is computed, and judges this one in its tests.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from dsar.raster.jit import kernel
from dsar.training.fused_ssim import similarity

_ZERO, _QUARTER, _HALF, _ONE = map(np.float32, (0, 0.25, 0.5, 1))


def fused_image_loss(
    color: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    truth: Float[Tensor, "h w 3"],
    mask: Float[Tensor, "h w"],
    levels: int,
    weights: tuple[float, float, float],
) -> Float[Tensor, ""]:
    """Return the weighted sum of pyramid L1, 1 - SSIM, and the mean absolute difference of alpha and mask.

    Gradients reach `color` and `alpha` only; float32 in main memory.
    """
    return _ImageLoss.apply(color, alpha, truth, mask, levels, weights)  # type: ignore[no-any-return]


class _ImageLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        *tensors, levels, (l1, ssim, cover) = inputs
        color, alpha, truth, mask = (tensor.detach().contiguous().numpy() for tensor in tensors)
        loss, v_color = _pyramid(color - truth, levels, l1)
        if ssim:
            score, v_similarity = similarity(color, truth)
            loss += ssim * (1 - score)
            v_color -= np.float32(ssim) * v_similarity
        difference = alpha - mask
        loss += cover * float(np.abs(difference).mean())
        v_alpha = np.sign(difference) * np.float32(cover / difference.size)
        ctx.gradients = torch.from_numpy(v_color), torch.from_numpy(v_alpha)
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_loss: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        v_color, v_alpha = ctx.gradients
        return v_color * v_loss, v_alpha * v_loss, None, None, None, None


def _pyramid(
    difference: Float32[np.ndarray, "h w 3"], levels: int, weight: float
) -> tuple[float, Float32[np.ndarray, "h w 3"]]:
    """Return the weighted mean absolute difference over levels, and its gradient by the finest one."""
    pyramid = [difference]
    for _ in range(levels - 1):
        pyramid.append(_halved(pyramid[-1]))
    loss, gradient = 0.0, np.zeros((0, 0, 3), np.float32)
    for level in reversed(pyramid):
        mean, gradient = _mean_and_gradient(level, gradient, np.float32(weight / levels / level.size))
        loss += mean
    return loss * weight / levels, gradient


@kernel
def _halved(image):
    """Return means over blocks of 2 x 2 pixels; blocks at an odd border hold fewer."""
    height, width = image.shape[0], image.shape[1]
    h, w = (height + 1) // 2, (width + 1) // 2
    result = np.empty((h, w, 3), np.float32)
    for y in range(h):
        above, below = image[2 * y], image[min(2 * y + 1, height - 1)]
        for x in range(w):
            left, right = 2 * x, min(2 * x + 1, width - 1)
            for c in range(3):
                # A block at a border holds its pixels twice, which leaves its mean.
                total = above[left, c] + above[right, c] + below[left, c] + below[right, c]
                result[y, x, c] = _QUARTER * total
    return result


@kernel
def _mean_and_gradient(level, coarser, weight):
    """Return a level's mean absolute difference, and the gradient of it and of coarser levels by the level.

    The gradient is the signs of the differences, and each pixel's share of the coarser level's gradient.
    """
    height, width = level.shape[0], level.shape[1]
    result, total = np.empty(level.shape, np.float32), 0.0
    for y in range(height):
        sums, alone_below = _ZERO, y == height - 1 and height % 2 == 1
        for x in range(width):
            alone = x == width - 1 and width % 2 == 1
            share = (_ONE if alone else _HALF) * (_ONE if alone_below else _HALF)
            for c in range(3):
                value = level[y, x, c]
                sums += abs(value)
                # Without a branch: signs of noise are guessed wrong half of the time.
                own = weight * (np.float32(value > 0) - np.float32(value < 0))
                result[y, x, c] = own + share * coarser[y >> 1, x >> 1, c] if len(coarser) > 0 else own
        total += sums
    return total / level.size, result
