"""What follows from a list of every pixel's Gaussians, for backends that draw no more than that list."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dsar.types import Contributors


def find_first_hit_depth(contributors: Contributors, depths: Float[Tensor, " n"]) -> Float[Tensor, "h w"]:
    """Return the depth of each pixel's first Gaussian, 0 where there is none.

    Args:
        contributors: Every pixel's Gaussians.
        depths: Of all Gaussians, camera-space z in metres.
    """
    counts = contributors.counts.flatten()
    hit, starts = counts > 0, counts.cumsum(0) - counts
    first_depths = depths.new_zeros(len(counts))
    first_depths[hit] = depths[contributors.ids[starts[hit]]]
    return first_depths.view(contributors.counts.shape)


def find_largest_weight_id(contributors: Contributors) -> Int[Tensor, "h w"]:
    """Return the Gaussian of each pixel's largest weight, the foremost of equals, -1 where there is none."""
    counts = contributors.counts.flatten()
    pixels = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    weights = contributors.weights
    largest = weights.new_zeros(len(counts)).scatter_reduce(0, pixels, weights, "amax")
    positions = torch.arange(len(weights), device=counts.device)
    beyond = len(weights)
    first = torch.full_like(counts, beyond).scatter_reduce(
        0, pixels, torch.where(weights == largest[pixels], positions, beyond), "amin"
    )
    ids = torch.cat([contributors.ids, contributors.ids.new_full((1,), -1)])
    return ids[first].view(contributors.counts.shape)
