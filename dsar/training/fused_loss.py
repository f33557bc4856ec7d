"""The image losses of `losses.py`, value and gradient together in compiled loops.

A training image is so small that as tensor operations its losses cost as much as rendering it. The plain
functions in `losses.py` say what is computed, and judge this one in its tests.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from dsar.raster.jit import inlined, kernel

_REACH, _SIGMA = 5, 1.5
_WINDOW = np.exp(-(np.arange(-_REACH, _REACH + 1) ** 2) / (2 * _SIGMA**2))
_WINDOW = (_WINDOW / _WINDOW.sum()).astype(np.float32)
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
_TWO, _ZERO = np.float32(2.0), np.float32(0.0)


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
            similarity, v_similarity = _similarity(color, truth)
            loss += ssim * (1 - similarity)
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
    loss = sum(float(np.abs(level).mean()) for level in pyramid) * weight / levels
    gradient = np.zeros((0, 0, 3), np.float32)
    for level in reversed(pyramid):
        gradient = _signs_and_coarser(level, gradient, np.float32(weight / levels / level.size))
    return loss, gradient


@kernel
def _halved(image):
    """Return means over blocks of 2 x 2 pixels; blocks at an odd border hold fewer."""
    h, w = (image.shape[0] + 1) // 2, (image.shape[1] + 1) // 2
    result = np.zeros((h, w, 3), np.float32)
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            for c in range(3):
                result[y // 2, x // 2, c] += image[y, x, c]
    for y in range(h):
        for x in range(w):
            count = min(2, image.shape[0] - 2 * y) * min(2, image.shape[1] - 2 * x)
            for c in range(3):
                result[y, x, c] /= np.float32(count)
    return result


@kernel
def _signs_and_coarser(level, coarser, weight):
    """Return the gradient by one level: its own signs, and its share of the coarser level's gradient."""
    result = np.empty(level.shape, np.float32)
    h, w = level.shape[0], level.shape[1]
    for y in range(h):
        for x in range(w):
            share = _ZERO
            if len(coarser) > 0:
                share = np.float32(1 / (min(2, h - y // 2 * 2) * min(2, w - x // 2 * 2)))
            for c in range(3):
                own = weight if level[y, x, c] > 0 else (-weight if level[y, x, c] < 0 else _ZERO)
                result[y, x, c] = own + (share * coarser[y // 2, x // 2, c] if len(coarser) > 0 else _ZERO)
    return result


@inlined
def _blur(image, window, across, out):
    """Blur the rows and columns of an [h, w * 3] image with the window, zero outside."""
    h, n = image.shape
    for y in range(h):
        across[y] = window[_REACH] * image[y]
        for tap in range(1, _REACH + 1):
            weight, shift = window[_REACH + tap], 3 * tap
            if shift < n:
                for x in range(n - shift):
                    across[y, x] += weight * image[y, x + shift]
                for x in range(n - shift):
                    across[y, x + shift] += weight * image[y, x]
    for y in range(h):
        out[y] = window[_REACH] * across[y]
        for tap in range(1, _REACH + 1):
            weight = window[_REACH + tap]
            if y + tap < h:
                for x in range(n):
                    out[y, x] += weight * across[y + tap, x]
            if y - tap >= 0:
                for x in range(n):
                    out[y, x] += weight * across[y - tap, x]


def _similarity(
    image: Float32[np.ndarray, "h w 3"], truth: Float32[np.ndarray, "h w 3"]
) -> tuple[float, Float32[np.ndarray, "h w 3"]]:
    """Return the mean structural similarity of two images in [0, 1], and its gradient by the first."""
    h, w, _ = image.shape
    similarity, gradient = _ssim(image.reshape(h, 3 * w), truth.reshape(h, 3 * w), _WINDOW)
    return similarity, gradient.reshape(h, w, 3)


@kernel
def _ssim(x, y, window):
    shape = x.shape
    across = np.empty(shape, np.float32)
    mx, my, mxx = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.float32)
    myy, mxy = np.empty(shape, np.float32), np.empty(shape, np.float32)
    _blur(x, window, across, mx)
    _blur(y, window, across, my)
    _blur(x * x, window, across, mxx)
    _blur(y * y, window, across, myy)
    _blur(x * y, window, across, mxy)
    total, per_pixel = 0.0, np.float32(1 / x.size)
    for i in range(shape[0]):
        for j in range(shape[1]):
            u, v = mx[i, j], my[i, j]
            a, b = _TWO * u * v + _C1, _TWO * (mxy[i, j] - u * v) + _C2
            c, d = u * u + v * v + _C1, mxx[i, j] - u * u + myy[i, j] - v * v + _C2
            score = a * b / (c * d)
            total += score
            # Derivatives by the blurred x, x² and xy, in the places of what they no longer need.
            mx[i, j] = per_pixel * _TWO * (v * (b - a) / (c * d) + u * score * (1 / d - 1 / c))
            mxx[i, j] = -per_pixel * score / d
            mxy[i, j] = per_pixel * _TWO * a / (c * d)
    # The blur is its own transpose.
    _blur(mx, window, across, my)
    _blur(mxx, window, across, myy)
    _blur(mxy, window, across, mx)
    return total / x.size, my + _TWO * x * myy + y * mx
