"""Image metrics, each on display-referred sRGB in [0, 1]."""

from jaxtyping import Float
from torch import Tensor


def psnr(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Return the peak signal-to-noise ratio in dB; values outside [0, 1] are clipped first."""
    mse = (image.clamp(0, 1) - truth.clamp(0, 1)).square().mean().clamp_min(1e-10)
    return float(-10 * mse.log10())


def correlation(a: Float[Tensor, " n"], b: Float[Tensor, " n"]) -> float:
    """Return Pearson's correlation; 0 where one of the two does not vary."""
    a, b = a.double() - a.double().mean(), b.double() - b.double().mean()
    norm = a.norm() * b.norm()
    return float(a @ b / norm) if norm > 1e-12 else 0.0
