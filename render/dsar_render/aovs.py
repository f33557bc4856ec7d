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
"""What the rasteriser itself is asked for."""


@dataclass(frozen=True)
class Moment:
    """The Gaussians of one time, and the camera as it then is."""

    gaussians: Gaussians
    camera: Camera


def make_aovs(
    wanted: Collection[str],
    output: RenderOutput,
    now: Moment,
    before: Moment | None,
    after: Moment | None,
    labels: Labels | None,
) -> Aovs:
    """Return the wanted output variables of an image that are not in the image itself.

    Args:
        wanted: Which.
        output: The image of `now`.
        now: What was drawn.
        before: A frame earlier; None where the motion begins.
        after: A frame later; None where the motion ends.
        labels: Parts, for `crypto`.
    """
    found: dict[str, Tensor] = {}
    if "N" in wanted:
        blended = blend_values(now.gaussians, now.camera, _facing(now.gaussians, now.camera))
        found["normals"] = torch.nn.functional.normalize(blended, dim=-1)
    if "P" in wanted:
        found["positions"] = _positions(output, now.camera)
    if "motion" in wanted:
        moved = torch.cat([_motion(now, after), _motion(now, before)], -1)
        blended = blend_values(now.gaussians, now.camera, moved)
        coverage = output.alpha[..., None]
        mean = torch.where(coverage > 0, blended / coverage, 0.0)
        found["forward"], found["backward"] = mean[..., :2], mean[..., 2:]
    coverage = cover(now, labels) if "crypto" in wanted and labels is not None else {}
    return Aovs(**found, coverage=coverage)


def cover(moment: Moment, labels: Labels) -> dict[str, Float[Tensor, "h w"]]:
    """Return each part's share of the alpha of every pixel."""
    ones = torch.eye(len(labels.names))[torch.from_numpy(labels.of).long()]
    shares = blend_values(moment.gaussians, moment.camera, ones).clamp_min(0)
    return dict(zip(labels.names, shares.unbind(-1), strict=True))


def _facing(gaussians: Gaussians, camera: Camera) -> Float[Tensor, "n 3"]:
    """Return the thinnest axis of each Gaussian, turned towards the camera: unit, world."""
    axes = matrix_from_quaternion(gaussians.rotations)
    thinnest = gaussians.scales.argmin(-1)
    normals = axes.gather(-1, thinnest[:, None, None].expand(-1, 3, 1)).squeeze(-1)
    away = ((camera.center.to(normals) - gaussians.means) * normals).sum(-1, keepdim=True) < 0
    return torch.where(away, -normals, normals)


def _positions(output: RenderOutput, camera: Camera) -> Float[Tensor, "h w 3"]:
    """Return the world point behind each pixel's centre at its expected depth, 0 where nothing was hit."""
    y, x = torch.nonzero(output.alpha > 0, as_tuple=True)
    positions = torch.zeros(*output.alpha.shape, 3)
    positions[y, x] = unproject(camera, torch.stack([x, y], -1) + 0.5, output.depth[y, x])
    return positions


def _motion(now: Moment, other: Moment | None) -> Float[Tensor, "n 2"]:
    """Return where each Gaussian is at another time, in pixels from where it is."""
    if other is None:
        return torch.zeros(len(now.gaussians), 2)
    here, depth = project(now.camera, now.gaussians.means)
    there, later = project(other.camera, other.gaussians.means)
    # What is or gets behind the camera has no place in the image; what comes close to its plane moves by
    # millions of pixels, which would leave no digits to the rest.
    before = (depth > NEAR) & (later > NEAR)
    reach = 4.0 * max(now.camera.width, now.camera.height)
    return torch.where(before[:, None], (there - here).clamp(-reach, reach), 0.0)
