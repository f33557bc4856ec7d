"""Small sets of Gaussians, and what pictures of them should hold."""

import dataclasses

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dsar.geometry.cameras import project
from dsar.types import Camera, Contributors, Gaussians, Picture

MIDDLE = 2
"""Which of the figure's six frames most tests look at."""


def some(count: int = 6, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(count, 3, generator=generator),
        rotations=normalize(torch.randn(count, 4, generator=generator), dim=-1),
        scales=torch.rand(count, 3, generator=generator) + 0.01,
        opacities=torch.rand(count, generator=generator),
        harmonics=torch.randn(count, 4, 3, generator=generator),
    )


def joined(one: Gaussians, two: Gaussians) -> Gaussians:
    return Gaussians(
        *(torch.cat([a, b]) for a, b in zip(vars(one).values(), vars(two).values(), strict=True))
    )


def moved(gaussians: Gaussians, offset: Tensor) -> Gaussians:
    return dataclasses.replace(gaussians, means=gaussians.means + offset)


def weighted_sum(contributors: Contributors, values: Tensor) -> Tensor:
    """Return the image that the definition of contributors asks for, added up in double precision."""
    counts = contributors.counts.flatten()
    pixels = torch.arange(len(counts)).repeat_interleave(counts)
    shares = contributors.weights.double()[:, None] * values.double()[contributors.ids]
    total = torch.zeros(len(counts), values.shape[1], dtype=torch.float64).index_add_(0, pixels, shares)
    return total.view(*contributors.counts.shape, -1)


def layers(picture: Picture) -> dict[str, Tensor]:
    """Return every image of a picture by name."""
    output, aovs = picture.output, picture.aovs
    found = {
        **{
            name: getattr(output, name)
            for name in ("color", "alpha", "depth", "first_hit_depth", "largest_weight_id")
        },
        **{name: getattr(aovs, name) for name in ("normals", "positions", "forward", "backward")},
        **aovs.coverage,
    }
    return {name: image for name, image in found.items() if image is not None}


def slab(front: Camera, gaussians: Gaussians, depth: float) -> Gaussians:
    """Return the Gaussians pushed along their rays onto one plane parallel to the image."""
    scale = depth / project(front, gaussians.means)[1]
    return dataclasses.replace(
        gaussians, means=front.center + (gaussians.means - front.center) * scale[:, None]
    )
