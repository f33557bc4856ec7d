"""Blending of Gaussians by definition, in every way between our rasteriser's and a ray tracer's.

Every pixel's centre meets every Gaussian, in double precision: for small scenes. What the two renderers do
otherwise is a choice each, so that each choice's share in their difference can be measured.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from dsar.geometry.harmonics import color_from_harmonics, harmonics_basis
from dsar.geometry.rotations import matrix_from_quaternion
from dsar.raster.conventions import ALPHA_MAX, ALPHA_MIN, EPS_2D, FRUSTUM_MARGIN, TRANSMITTANCE_MIN
from dsar.types import Camera, Gaussians

EXTENT = 3.0
"""Standard deviations at which a traced Gaussian ends."""
_TRACED_ALPHA_MAX = 0.9999
TRACED_STOP = 0.01


@dataclass(frozen=True)
class Choices:
    """What renderers of Gaussians may do in one way or the other."""

    low_pass: bool = True
    """Splats are widened by 0.3 pixels²."""
    ewa_projection: bool = True
    """A Gaussian is projected as an ellipse (EWA), rather than met at its densest place along the ray."""
    colors_of_centers: bool = True
    """Harmonics are evaluated towards a Gaussian's centre, rather than along the pixel's own ray."""
    our_limits: bool = True
    """Faint fragments are skipped and light is followed to 1e-4, rather than ends at 3 deviations and .01."""
    order_of_centers: bool = True
    """Blended in the order of the centres' depths, rather than that in which the ray enters ellipsoids."""


@dataclass(frozen=True)
class Step:
    """One more choice made as the ray tracer makes it."""

    name: str
    description: str
    """The same for people."""
    choices: Choices


OURS = Choices()
STEPS = (
    Step("low_pass", "splats are no longer widened by 0.3 pixels²", Choices(False)),
    Step("projection", "densest place along the ray, for a projected ellipse", Choices(False, False)),
    Step("view_directions", "colours along the ray, not to the centre", Choices(False, False, False)),
    Step("limits", "ends at 3 deviations and 1 % of light", Choices(False, False, False, False)),
    Step("order", "by where rays enter, not by centres", Choices(False, False, False, False, False)),
)
"""From our choices to the ray tracer's."""


@dataclass(frozen=True)
class _Intersections:
    """Every pixel's ray and every Gaussian."""

    powers: Float[np.ndarray, "p n"]
    """Half the squared distance in standard deviations."""
    order: Float[np.ndarray, "p n"]
    """What is smaller is in front."""
    missed: np.ndarray
    """Where the ray does not come within the Gaussian's extent."""


def blend(gaussians: Gaussians, camera: Camera, choices: Choices) -> Float[np.ndarray, "h w 4"]:
    """Return colour (premultiplied) and alpha of the pixels' centres."""
    rays = _rays(camera)
    hits = _intersect(gaussians, camera, rays, choices)
    colors = _colors(gaussians, camera, rays, choices)
    opacity = gaussians.opacities.double().numpy()
    alphas = opacity * np.exp(-hits.powers)
    if choices.our_limits:
        alphas = np.where(alphas < ALPHA_MIN, 0.0, np.minimum(alphas, ALPHA_MAX))
    else:
        alphas = np.where(hits.missed, 0.0, np.minimum(alphas, _TRACED_ALPHA_MAX))
    order = np.argsort(hits.order, axis=1, kind="stable")
    alphas = np.take_along_axis(alphas, order, 1)
    transmittance = np.cumprod(1 - alphas, axis=1)
    before = np.concatenate([np.ones((len(transmittance), 1)), transmittance[:, :-1]], 1)
    # Ours leaves out the fragment that would end the pixel; theirs ends after it.
    contributes = transmittance > TRANSMITTANCE_MIN if choices.our_limits else before > TRACED_STOP
    weights = before * alphas * contributes
    if colors.ndim == 2:
        image = np.einsum("pn,pnc->pc", weights, colors[order])
    else:
        image = np.einsum("pn,pnc->pc", weights, np.take_along_axis(colors, order[..., None], 1))
    rgba = np.concatenate([image, weights.sum(1, keepdims=True)], 1)
    return rgba.reshape(camera.height, camera.width, 4)


def _rays(camera: Camera) -> Float[np.ndarray, "p 3"]:
    """Return the unit directions through the pixels' centres, in the world."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)], -1)
    local = pixels @ np.linalg.inv(camera.K.double().numpy()).T
    directions = local @ camera.T_camera_world[:3, :3].double().numpy()
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _intersect(
    gaussians: Gaussians, camera: Camera, rays: Float[np.ndarray, "p 3"], choices: Choices
) -> _Intersections:
    axes = matrix_from_quaternion(gaussians.rotations.double()).numpy()
    scales, means = gaussians.scales.double().numpy(), gaussians.means.double().numpy()
    origin = camera.center.double().numpy()
    # In each Gaussian's own axes, in standard deviations.
    o = np.einsum("nij,ni->nj", axes, origin - means) / scales
    d = np.einsum("nij,pi->pnj", axes, rays) / scales
    length = (d**2).sum(-1)
    nearest = -(o * d).sum(-1) / length
    distance = ((o + nearest[..., None] * d) ** 2).sum(-1)
    missed = distance > EXTENT**2
    local = means @ camera.T_camera_world[:3, :3].double().numpy().T
    local += camera.T_camera_world[:3, 3].double().numpy()
    if choices.ewa_projection:
        powers = _splat_powers(camera, local, axes * scales[:, None], 0.0 if not choices.low_pass else EPS_2D)
    else:
        powers = distance / 2
    entry = nearest - np.sqrt(np.maximum(EXTENT**2 - distance, 0) / length)
    order = np.broadcast_to(local[:, 2], powers.shape) if choices.order_of_centers else entry
    return _Intersections(powers, order, missed)


def _splat_powers(
    camera: Camera, local: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "n 3 3"], low_pass: float
) -> Float[np.ndarray, "p n"]:
    """Return the powers of the ellipses that Gaussians are projected to."""
    K = camera.K.double().numpy()
    x, y, z = local.T
    J = np.zeros((len(local), 2, 3))
    for axis, (tangent, size) in enumerate(((x / z, camera.width), (y / z, camera.height))):
        # Linearised at the edge of a somewhat wider image where a centre lies beyond it.
        margin = FRUSTUM_MARGIN / 2 * size
        low, high = ((edge - K[axis, 2]) / K[axis, axis] for edge in (-margin, size + margin))
        J[:, axis, axis] = K[axis, axis] / z
        J[:, axis, 2] = -K[axis, axis] * np.clip(tangent, low, high) / z
    projected_axes = J @ (camera.T_camera_world[:3, :3].double().numpy() @ axes)
    covariance = projected_axes @ projected_axes.transpose(0, 2, 1) + low_pass * np.eye(2)
    centers = np.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], -1)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    offsets = np.stack([columns.ravel(), rows.ravel()], -1)[:, None] - centers
    return np.einsum("pni,nij,pnj->pn", offsets, np.linalg.inv(covariance), offsets) / 2


def _colors(
    gaussians: Gaussians, camera: Camera, rays: Float[np.ndarray, "p 3"], choices: Choices
) -> Float[np.ndarray, "*pn 3"]:
    """Return colours, one a Gaussian or one a pixel and Gaussian."""
    harmonics = gaussians.harmonics.double()
    if harmonics.shape[1] == 1 or choices.colors_of_centers:
        toward = torch.nn.functional.normalize(gaussians.means.double() - camera.center.double(), dim=-1)
        return color_from_harmonics(harmonics, toward).numpy()
    basis = harmonics_basis(torch.from_numpy(rays), harmonics.shape[1])
    return (torch.einsum("pk,nkc->pnc", basis, harmonics) + 0.5).clamp_min(0).numpy()
