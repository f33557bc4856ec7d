"""The transfer curve of sRGB (IEC 61966-2-1), between display-referred values and linear light."""

import numpy as np
from jaxtyping import Float


def linear_from_srgb(color: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Decode sRGB to linear light; values above 1 follow the same curve, below 0 become 0."""
    color = np.maximum(color, color.dtype.type(0))
    curve = ((color + color.dtype.type(0.055)) / color.dtype.type(1.055)) ** color.dtype.type(2.4)
    return np.where(color <= 0.04045, color / color.dtype.type(12.92), curve)


def srgb_from_linear(light: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Encode linear light as sRGB: the inverse of `linear_from_srgb`."""
    light = np.maximum(light, light.dtype.type(0))
    curve = light ** light.dtype.type(1 / 2.4) * light.dtype.type(1.055) - light.dtype.type(0.055)
    return np.where(light <= 0.04045 / 12.92, light * light.dtype.type(12.92), curve)
