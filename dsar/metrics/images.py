"""PSNR and SSIM of images, display-referred sRGB in [0, 1], and the box that they are taken in."""

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from dsar.devices import send

_SSIM_WINDOW, _SSIM_SIGMA = 11, 1.5


def psnr(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Return the peak signal-to-noise ratio in dB; values outside [0, 1] are clipped first."""
    return decibels((image.clamp(0, 1) - truth.clamp(0, 1)).square().mean())


def decibels(mse: Float[Tensor, ""] | float) -> float:
    """Return the signal-to-noise ratio of a mean squared error against a peak of 1; 100 dB at most."""
    if isinstance(mse, Tensor):
        return float(-10 * mse.clamp_min(1e-10).log10())
    return -10 * math.log10(max(mse, 1e-10))


def ssim(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Return the mean structural similarity of two images in [0, 1] (Wang et al. 2004; 11x11 Gaussian)."""
    return ssim_map(image, target).mean()


def ssim_map(
    image: Float[Tensor, "*views h w 3"], target: Float[Tensor, "*views h w 3"]
) -> Float[Tensor, "*views 3 h w"]:
    """Return the structural similarity around each pixel; what is outside the image is zero."""
    x, y = image.movedim(-1, -3), target.movedim(-1, -3)
    moments = torch.cat([x, y, x * x, y * y, x * y], -3)
    # As two products with banded matrices, four times faster than single-channel convolutions.
    rows, columns = (_blur_matrix(size, image.dtype, image.device) for size in image.shape[-3:-1])
    moments = rows @ moments @ columns.mT
    mx, my, mxx, myy, mxy = moments.chunk(5, -3)
    vx, vy, vxy = mxx - mx * mx, myy - my * my, mxy - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return (2 * mx * my + c1) * (2 * vxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))


@lru_cache(maxsize=512)
def _blur_matrix(size: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "s s"]:
    """Return the matrix that blurs a line of pixels with SSIM's window, zero outside."""
    distance = torch.arange(size)[:, None] - torch.arange(size)
    window = torch.exp(-(distance**2) / (2 * _SSIM_SIGMA**2)) * (distance.abs() <= _SSIM_WINDOW // 2)
    reach = torch.arange(_SSIM_WINDOW) - _SSIM_WINDOW // 2
    return send((window / torch.exp(-(reach**2) / (2 * _SSIM_SIGMA**2)).sum()).to(dtype), device)


def mask_box(alpha: Shaped[np.ndarray, "h w"], margin: int) -> tuple[int, int, int, int]:
    """Return (x0, y0, x1, y1) of what is not transparent, with a margin; the whole image if nothing is."""
    h, w = alpha.shape
    rows, columns = np.flatnonzero(alpha.any(1)), np.flatnonzero(alpha.any(0))
    if not len(rows):
        return 0, 0, w, h
    tight = int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
    return with_margin(tight, margin, w, h)


def with_margin(
    box: tuple[int, int, int, int], margin: int, width: int, height: int
) -> tuple[int, int, int, int]:
    """Return a box (x0, y0, x1, y1) widened by a margin, within an image."""
    x0, y0, x1, y1 = box
    return max(x0 - margin, 0), max(y0 - margin, 0), min(x1 + margin, width), min(y1 + margin, height)
