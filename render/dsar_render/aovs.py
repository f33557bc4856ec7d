"""Arbitrary output variables: what each pixel shows, besides its colour."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.geometry.cameras import project, unproject
from dsar.geometry.rotations import matrix_from_quaternion
from dsar.raster import Output
from dsar.raster.conventions import NEAR
from dsar.types import Aovs, Camera, Gaussians, RenderOutput
from dsar_render.blending import blend_values
from dsar_render.labels import Labels

Aov = Literal["rgba", "alpha", "Z", "N", "P", "motion", "id", "crypto"]
AOVS: tuple[Aov, ...] = get_args(Aov)
RASTER_OUTPUTS: dict[str, Output] = {"Z": "first_hit_depth", "id": "largest_weight_id"}
"""Output variables that the rasteriser itself computes, and what it calls them."""


@dataclass(frozen=True)
class TimeSample:
    """The Gaussians of one time, and the camera as it then is."""

    gaussians: Gaussians
    camera: Camera


def make_aovs(
    names: Collection[str],
    output: RenderOutput,
    current: TimeSample,
    previous: TimeSample | None,
    following: TimeSample | None,
    labels: Labels | None,
) -> Aovs:
    """Return the wanted output variables of an image that are not in the image itself.

    Args:
        names: Which, of `AOVS`.
        output: The image of `current`.
        current: What was drawn.
        previous: A frame earlier; None where the motion begins.
        following: A frame later; None where the motion ends.
        labels: Parts, for `crypto`.
    """
    images: dict[str, Tensor] = {}
    if "N" in names:
        blended = blend_values(
            current.gaussians, current.camera, _oriented_normals(current.gaussians, current.camera)
        )
        images["normals"] = torch.nn.functional.normalize(blended, dim=-1)
    if "P" in names:
        images["positions"] = _positions(output, current.camera)
    if "motion" in names:
        vectors = torch.cat([_motion_vectors(current, following), _motion_vectors(current, previous)], -1)
        blended = blend_values(current.gaussians, current.camera, vectors)
        coverage = output.alpha[..., None]
        mean = torch.where(coverage > 0, blended / coverage, 0.0)
        images["forward"], images["backward"] = mean[..., :2], mean[..., 2:]
    coverage = part_coverage(current, labels) if "crypto" in names and labels is not None else {}
    return Aovs(**images, coverage=coverage)


def part_coverage(sample: TimeSample, labels: Labels) -> dict[str, Float[Tensor, "h w"]]:
    """Return each part's share of the alpha of every pixel."""
    ones = torch.eye(len(labels.names))[torch.from_numpy(labels.indices).long()]
    shares = blend_values(sample.gaussians, sample.camera, ones).clamp_min(0)
    return dict(zip(labels.names, shares.unbind(-1), strict=True))


def _oriented_normals(gaussians: Gaussians, camera: Camera) -> Float[Tensor, "n 3"]:
    """Return the thinnest axis of each Gaussian, of the two signs the one towards the camera: unit, world."""
    axes = matrix_from_quaternion(gaussians.rotations)
    thinnest = gaussians.scales.argmin(-1)
    normals = axes.gather(-1, thinnest[:, None, None].expand(-1, 3, 1)).squeeze(-1)
    faces_away = ((camera.center.to(normals) - gaussians.means) * normals).sum(-1, keepdim=True) < 0
    return torch.where(faces_away, -normals, normals)


def _positions(output: RenderOutput, camera: Camera) -> Float[Tensor, "h w 3"]:
    """Return the world point behind each pixel's centre at its expected depth, 0 where nothing was hit."""
    y, x = torch.nonzero(output.alpha > 0, as_tuple=True)
    positions = torch.zeros(*output.alpha.shape, 3)
    positions[y, x] = unproject(camera, torch.stack([x, y], -1) + 0.5, output.depth[y, x])
    return positions


def _motion_vectors(current: TimeSample, other: TimeSample | None) -> Float[Tensor, "n 2"]:
    """Return where each Gaussian is at another time, in pixels from where it is."""
    if other is None:
        return torch.zeros(len(current.gaussians), 2)
    pixels, depth = project(current.camera, current.gaussians.means)
    other_pixels, other_depth = project(other.camera, other.gaussians.means)
    # What is or gets behind the camera has no place in the image; what comes close to its plane moves by
    # millions of pixels, which would leave no digits to the rest.
    in_front = (depth > NEAR) & (other_depth > NEAR)
    limit = 4.0 * max(current.camera.width, current.camera.height)
    return torch.where(in_front[:, None], (other_pixels - pixels).clamp(-limit, limit), 0.0)
