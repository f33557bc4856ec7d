"""Images of several sizes as one batch, so that a GPU compares all of them in a few operations.

Each lies at its upper left, with zeros around it. What is outside an image never counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import avg_pool2d

from dsar.devices import send
from dsar.metrics.images import ssim_map


@dataclass(frozen=True)
class Padding:
    """Where the pixels of some images are in their batch."""

    shape: tuple[int, int, int]
    """Images, and height and width of the largest."""
    index: Int64[Tensor, " n"]
    """Place of each pixel of all images, one after another, in the flat batch."""
    counts: Float[Tensor, "levels v"]
    """Pixels of each image on every level of its pyramid."""

    @classmethod
    def of(cls, sizes: Sequence[tuple[int, int]], levels: int, device: torch.device) -> "Padding":
        """Return the padding of images of some heights and widths, with pyramids of so many levels."""
        height, width = (max(size[axis] for size in sizes) for axis in (0, 1))
        places = torch.arange(len(sizes) * height * width).reshape(-1, height, width)
        index = torch.cat([own[:h, :w].flatten() for own, (h, w) in zip(places, sizes, strict=True)])
        counts, level_sizes = [], torch.tensor(sizes)
        for _ in range(levels):
            counts.append(level_sizes.prod(1).float())
            level_sizes = (level_sizes + 1) // 2
        return cls((len(sizes), height, width), send(index, device), send(torch.stack(counts), device))

    def pad(self, pixels: Float[Tensor, "n c"]) -> Float[Tensor, "v c h w"]:
        """Return the batch of the pixels of all images, one after another."""
        images, height, width = self.shape
        flat = pixels.new_zeros(images * height * width, pixels.shape[1]).index_copy(0, self.index, pixels)
        return flat.view(images, height, width, -1).permute(0, 3, 1, 2)

    def inside(self, like: Tensor) -> Float[Tensor, "v 1 h w"]:
        """Return 1 in the images and 0 around them."""
        return self.pad(like.new_ones(len(self.index), 1))


def padded_losses(
    colors: Float[Tensor, "v 4 h w"],
    truths: Float[Tensor, "v 4 h w"],
    padding: Padding,
    levels: int,
    weights: tuple[float, float, float],
) -> tuple[Float[Tensor, " v"], Float[Tensor, " v"]]:
    """Return each image's loss and mean squared error.

    The loss is the weighted sum of L1 over a pyramid, of 1 - SSIM, and of the mean absolute difference of
    alpha and mask. L1 is the mean absolute difference, averaged over `levels` that halve the resolution;
    blocks at an odd border hold fewer pixels. Coarse levels pull a garment towards a place that it does not
    overlap yet.

    Args:
        colors: sRGB over a background, and alpha; 0 outside.
        truths: What they should be, and the mask; 0 outside.
        padding: Says which pixels belong to the images.
        levels: Of the pyramid.
        weights: Of L1, of 1 - SSIM and of the difference of alpha and mask.
    """
    l1, similarity, cover = weights
    inside = padding.inside(colors)
    counts = padding.counts.to(colors)[..., None, None, None]
    difference = colors - truths
    share = inside / counts[0]
    errors = (difference[:, :3].detach().square() * share / 3).sum((1, 2, 3))
    loss = cover * (difference[:, 3:].abs() * share).sum((1, 2, 3))
    if similarity:
        scores = ssim_map(*(image[:, :3].permute(0, 2, 3, 1) for image in (colors, truths)))
        loss = loss + similarity * (1 - (scores * share / 3).sum((1, 2, 3)))
    difference, total = difference[:, :3], colors.new_zeros(len(colors))
    for level in range(levels):
        if level:
            covered = _halved(inside)
            # Blocks at a border are means of the pixels that they have.
            difference = _halved(difference) / covered.clamp_min(torch.finfo(covered.dtype).tiny)
            inside = covered.ceil()
        total = total + (difference.abs() * (inside / counts[level] / 3)).sum((1, 2, 3))
    return loss + l1 * total / levels, errors


def _halved(images: Float[Tensor, "v c h w"]) -> Float[Tensor, "v c h2 w2"]:
    return avg_pool2d(images, 2, ceil_mode=True, count_include_pad=False)
