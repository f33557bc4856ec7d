"""Deep images: the Gaussians of each pixel as samples at their depths."""

import numpy as np
import torch
from jaxtyping import Float, Int

from dsar.geometry.cameras import project
from dsar.geometry.harmonics import color_from_harmonics
from dsar.types import Camera, DeepSamples, Gaussians, RenderOutput


def sample_deep(
    output: RenderOutput, gaussians: Gaussians, camera: Camera, *, max_samples: int
) -> DeepSamples:
    """Return the samples of an image, which flattened give its alpha and its display-referred colour.

    A sample lies at the depth of its Gaussian's centre: the order in which the image was blended, so that
    flattening by depth is the same blend. Where a pixel has more than `max_samples` Gaussians, neighbours
    in depth become one sample, none with much more than its equal share of the pixel unless it is one
    Gaussian.

    Args:
        output: The image, with its contributors.
        gaussians: What was drawn.
        camera: Its camera.
        max_samples: At least 1.
    """
    assert output.contributors is not None
    counts = output.contributors.counts.numpy().ravel()
    ids, weights = output.contributors.ids.numpy(), output.contributors.weights.numpy().astype(np.float64)
    directions = torch.nn.functional.normalize(gaussians.means - camera.center.to(gaussians.means), dim=-1)
    colors = color_from_harmonics(gaussians.harmonics, directions).numpy()
    z = project(camera, gaussians.means)[1].double().numpy()
    before = _alpha_in_front(counts, weights)
    groups = _sample_of_each(counts, weights, before, max_samples)
    starts = np.flatnonzero(np.diff(groups, prepend=-1))
    pixels = np.repeat(np.arange(len(counts)), counts)[starts]
    total = _sum_runs(weights, starts)
    depths = _sum_runs(weights * z[ids], starts) / total
    sampled = np.bincount(pixels, minlength=len(counts)).reshape(output.alpha.shape)
    largest = ids[_argmax_weight(weights, groups, starts)]
    return DeepSamples(
        counts=torch.from_numpy(sampled),
        colors=_float32(_sum_runs(weights[:, None] * colors[ids], starts) / total[:, None]),
        alphas=_float32(total / (1 - before[starts])),
        depths=_float32(_non_decreasing(depths, pixels)),
        ids=torch.from_numpy(largest.astype(np.int64)),
    )


def _alpha_in_front(
    counts: Int[np.ndarray, " p"], weights: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " m"]:
    """Return the alpha of all that lies in front of each contribution in its pixel."""
    total = np.concatenate([[0.0], np.cumsum(weights)])
    return total[:-1] - np.repeat(total[np.cumsum(counts) - counts], counts)


def _sample_of_each(
    counts: Int[np.ndarray, " p"],
    weights: Float[np.ndarray, " m"],
    before: Float[np.ndarray, " m"],
    max_samples: int,
) -> Int[np.ndarray, " m"]:
    """Return each contribution's sample: numbers that never fall, and rise at every new pixel."""
    pixels = np.repeat(np.arange(len(counts)), counts)
    order = np.arange(len(weights)) - (np.cumsum(counts) - counts)[pixels]
    alphas = np.bincount(pixels, weights, len(counts))[pixels]
    quantile = np.minimum((before / alphas * max_samples).astype(np.int64), max_samples - 1)
    within = np.where(counts[pixels] > max_samples, quantile, order)
    return pixels * (int(counts.max(initial=0)) + max_samples) + within


def _sum_runs(values: Float[np.ndarray, "m *c"], starts: Int[np.ndarray, " s"]) -> Float[np.ndarray, "s *c"]:
    """Return the sums of runs of values."""
    return np.add.reduceat(values, starts, axis=0) if len(starts) else values[:0]


def _argmax_weight(
    weights: Float[np.ndarray, " m"], groups: Int[np.ndarray, " m"], starts: Int[np.ndarray, " s"]
) -> Int[np.ndarray, " s"]:
    """Return where the largest weight of each group stands."""
    return np.lexsort((-weights, groups))[starts]


def _non_decreasing(
    depths: Float[np.ndarray, " s"], pixels: Int[np.ndarray, " s"]
) -> Float[np.ndarray, " s"]:
    """Return depths in which none lies before the one in front of it, by the last digit of its rounding."""
    while True:
        wrong = np.flatnonzero((np.diff(depths) < 0) & (np.diff(pixels) == 0)) + 1
        if not len(wrong):
            return depths
        depths[wrong] = depths[wrong - 1]


def _float32(values: Float[np.ndarray, "*s"]) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32))
