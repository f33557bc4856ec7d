"""How images change from frame to frame.

What a pixel shows was somewhere else a frame ago: the Gaussians themselves say where, so that no optical flow
has to be estimated.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from dsar.geometry.cameras import project
from dsar.metrics.images import decibels
from dsar.types import Camera, Gaussians, RenderOutput

_OPAQUE = 0.95
"""Pixels that are less covered show the background, too, which does not move with the Gaussians."""

_SAME_DEPTH = 0.02
"""Metres between where a pixel's Gaussians were and what was seen there: farther, and they were hidden."""


def temporal_psnr(
    images: tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]],
    truths: tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]],
) -> float:
    """Return the peak signal-to-noise ratio of the change between two frames in dB; a full change is 1."""
    change, true_change = (after.clamp(0, 1) - before.clamp(0, 1) for before, after in (images, truths))
    return decibels((change - true_change).square().mean())


def trace_back(
    now: RenderOutput, gaussians: Gaussians, before: Gaussians, camera: Camera
) -> tuple[Float[Tensor, "h w 2"], Float[Tensor, "h w"]]:
    """Return where each pixel's Gaussians were a frame before.

    Args:
        now: The image of `gaussians` with its contributors.
        gaussians: Those of this frame.
        before: The same Gaussians in the frame before.
        camera: Of both frames.

    Returns:
        Their displacement back in pixels (x, y) and their depth then in metres: means by weight. Both are 0
        where nothing was hit.
    """
    assert now.contributors is not None
    counts, ids, weights = now.contributors.counts, now.contributors.ids, now.contributors.weights
    (here, _), (there, depth) = project(camera, gaussians.means), project(camera, before.means)
    values = torch.cat([there - here, depth[:, None]], 1)
    pixel = torch.repeat_interleave(torch.arange(counts.numel(), device=counts.device), counts.flatten())
    sums = values.new_zeros(counts.numel(), 3).index_add_(0, pixel, weights[:, None] * values[ids])
    total = weights.new_zeros(counts.numel()).index_add_(0, pixel, weights)
    means = (sums / total.clamp_min(1e-12)[:, None]).reshape(*counts.shape, 3)
    return means[..., :2], means[..., 2]


def warp_error(
    before: RenderOutput,
    now: RenderOutput,
    back: Float[Tensor, "h w 2"],
    depth: Float[Tensor, "h w"],
) -> float | None:
    """Return the mean squared difference between an image and the last one, moved as the Gaussians moved.

    Pixels that are not covered in both, or were hidden in the last one, do not count (Lai et al. 2018, with
    our own motion in place of optical flow). None where no pixel counts. A model whose colours stick to its
    surface scores 0 up to resampling.

    Args:
        before: The last image.
        now: This one, of the same camera.
        back: From `trace_back`, pixels.
        depth: From `trace_back`, metres.
    """
    warped, visible = _fetch(before, back, depth)
    visible &= now.alpha > _OPAQUE
    if not visible.any():
        return None
    return float((now.color - warped)[visible].square().mean())


def _fetch(
    before: RenderOutput, back: Float[Tensor, "h w 2"], depth: Float[Tensor, "h w"]
) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
    """Return the last image's colours at the places of this one's pixels, and where they were visible."""
    height, width = depth.shape
    rows, columns = torch.meshgrid(
        torch.arange(height, device=depth.device), torch.arange(width, device=depth.device), indexing="ij"
    )
    # Pixel (0, 0) has its centre at (0.5, 0.5), and -1 and 1 are the image's outer edges.
    places = torch.stack([columns + 0.5, rows + 0.5], -1) + back
    grid = 2 * places / places.new_tensor([width, height]) - 1
    layers = torch.cat([before.color, before.alpha[..., None], (before.alpha * before.depth)[..., None]], -1)
    warped = grid_sample(layers.movedim(-1, 0)[None], grid[None], align_corners=False)[0].movedim(0, -1)
    alpha = warped[..., 3]
    depth_there = warped[..., 4] / alpha.clamp_min(1e-6)
    return warped[..., :3], (alpha > _OPAQUE) & ((depth_there - depth).abs() < _SAME_DEPTH)
