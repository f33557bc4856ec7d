"""Deep EXR: every pixel's samples, front to back, with their alpha, depth and Gaussian."""

import numpy as np
from jaxtyping import Float

from dsar.types import DeepSamples
from dsar_exporters.color import ColorTarget

_MIN_LIGHT = 1e-9
"""Below this a pixel's light is none."""


def deep_channels(
    samples: DeepSamples, flat: Float[np.ndarray, "h w 3"], target: ColorTarget, rows: slice, columns: slice
) -> dict[str, np.ndarray]:
    """Return R, G, B (premultiplied by the sample's alpha), A, Z and `particleid` of a rectangle of pixels.

    Blending happened in display-referred colours, so the sum of the samples' linear colours is not the linear
    colour of their blend. Each pixel's samples are scaled by one factor a channel, so that flattened they
    give the flat image.

    Args:
        samples: Of the whole image.
        flat: The flat image in the target's colour space, premultiplied.
        target: The colour space of R, G and B.
        rows: Of the rectangle.
        columns: Of the rectangle.
    """
    counts = samples.counts.numpy().ravel()
    pixels = np.repeat(np.arange(len(counts)), counts)
    alphas = samples.alphas.numpy()
    weights = alphas * _transmittance(alphas, counts)
    colors = target.from_display(samples.colors.numpy())
    light = np.stack([np.bincount(pixels, weights * colors[:, c], len(counts)) for c in range(3)], -1)
    # Of no samples at all NumPy counts integers.
    light = light.astype(np.float64)
    target_light = flat.reshape(-1, 3)
    factors = np.divide(target_light, light, out=np.zeros_like(light), where=np.abs(light) > _MIN_LIGHT)
    shaded = (colors * factors[pixels] * alphas[:, None]).astype(np.float32)
    flat_channels = {
        **{name: np.ascontiguousarray(shaded[:, index]) for index, name in enumerate("RGB")},
        "A": alphas,
        "Z": samples.depths.numpy(),
        "particleid": samples.ids.numpy().astype(np.uint32),
    }
    inside = np.arange(len(counts)).reshape(samples.counts.shape)[rows, columns]
    starts = np.cumsum(counts) - counts
    return {name: _ragged(values, inside, starts, counts) for name, values in flat_channels.items()}


def _transmittance(alphas: Float[np.ndarray, " m"], counts: np.ndarray) -> Float[np.ndarray, " m"]:
    """Return what all samples in front of each one in its pixel let through."""
    log_transmittance = np.log1p(-alphas.astype(np.float64))
    total = np.cumsum(log_transmittance) - log_transmittance
    hit = np.flatnonzero(counts)
    starts = (np.cumsum(counts) - counts)[hit]
    return np.exp(total - np.repeat(total[starts], counts[hit]))


def _ragged(values: np.ndarray, pixels: np.ndarray, starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return an array of each pixel's values, None where there are none."""
    ragged = np.empty(pixels.size, object)
    # Where all are None a channel has no type.
    ragged[0] = values[:0]
    flat_pixels = pixels.ravel()
    hit = np.flatnonzero(counts[flat_pixels])
    first = starts[flat_pixels[hit]]
    last = first + counts[flat_pixels[hit]]
    for index, start, end in zip(hit.tolist(), first.tolist(), last.tolist(), strict=True):
        ragged[index] = values[start:end]
    return ragged.reshape(pixels.shape)
