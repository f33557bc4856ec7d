"""The slow backend: the same image in plain torch, any dtype or device, differentiable in everything.

It is what the fast kernels are tested against, so it follows the formulas and not the machine.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dsar.geometry.harmonics import color_from_harmonics
from dsar.geometry.rotations import matrix_from_quaternion
from dsar.raster.conventions import (
    ALPHA_MAX,
    ALPHA_MIN,
    EPS_2D,
    FRUSTUM_MARGIN,
    NEAR,
    TRANSMITTANCE_MIN,
)
from dsar.types import Camera, Gaussians, RenderOutput

_TILE = 16


@dataclass(frozen=True)
class _Splats:
    """Gaussians on the image, front to back."""

    means: Float[Tensor, "n 2"]
    """Pixels."""
    covariances: Float[Tensor, "n 2 2"]
    """Pixels², dilated."""
    opacities: Float[Tensor, " n"]
    features: Float[Tensor, "n 4"]
    """Red, green, blue, and camera depth in metres."""
    radii: Float[Tensor, "n 2"]
    """Half-width and half-height in pixels outside which alpha < ALPHA_MIN."""


def rasterize_reference(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Tensor, "3"] | None = None,
    directions: Float[Tensor, "n 3"] | None = None,
    dilation: float = EPS_2D,
) -> RenderOutput:
    """Rasterise in plain torch: `dsar.raster.rasterize` without its checks, for any dtype and device."""
    drawable = _find_drawable(gaussians, camera, directions)
    # Selected before anything is computed: what is left out cannot send NaN back through a zero gradient.
    gaussians = gaussians.map(lambda values: values[drawable])
    splats = _splat(gaussians, camera, directions if directions is None else directions[drawable], dilation)
    rows = [
        torch.cat([_composite_tile(splats, x, y, camera) for x in range(0, camera.width, _TILE)], 1)
        for y in range(0, camera.height, _TILE)
    ]
    color, alpha, depth = torch.cat(rows, 0).split([3, 1, 1], -1)
    hit = alpha > 0
    depth = torch.where(hit, depth / torch.where(hit, alpha, 1), 0)
    if background is not None:
        color = color + (1 - alpha) * background
    return RenderOutput(color, alpha[..., 0], depth[..., 0])


@torch.no_grad()
def _find_drawable(
    gaussians: Gaussians, camera: Camera, directions: Float[Tensor, "n 3"] | None
) -> Bool[Tensor, " n"]:
    """Return which Gaussians are in front, visible, of positive scale, and finite in all they project to."""
    means, covariances, depths = _project(gaussians, camera, EPS_2D)
    drawable = (depths > NEAR) & (gaussians.opacities >= ALPHA_MIN) & (gaussians.scales > 0).all(-1)
    drawable &= gaussians.rotations.norm(dim=-1) > 0
    colors = _shade(gaussians, camera, directions)
    for values in (means, covariances.flatten(1), gaussians.opacities[:, None], colors):
        drawable &= values.isfinite().all(-1)
    return drawable


def _splat(
    gaussians: Gaussians, camera: Camera, directions: Float[Tensor, "n 3"] | None, dilation: float
) -> _Splats:
    """Return drawable Gaussians on the image, front to back, ties in their own order."""
    means, covariances, depths = _project(gaussians, camera, dilation)
    features = torch.cat([_shade(gaussians, camera, directions), depths[:, None]], -1)
    reach = 2 * (gaussians.opacities.detach() / ALPHA_MIN).log()
    variances = covariances.detach().diagonal(dim1=-2, dim2=-1)
    # A pixel more than needed: the blending itself cuts at ALPHA_MIN.
    radii = (reach[:, None] * variances).sqrt() + 1
    order = depths.detach().argsort(stable=True)
    return _Splats(*(v[order] for v in (means, covariances, gaussians.opacities, features, radii)))


def _shade(
    gaussians: Gaussians, camera: Camera, directions: Float[Tensor, "n 3"] | None
) -> Float[Tensor, "n 3"]:
    """Return the colour of each Gaussian, seen along `directions` or else from the camera."""
    if directions is None:
        center = camera.center.to(gaussians.means)
        directions = torch.nn.functional.normalize(gaussians.means - center, dim=-1)
    return color_from_harmonics(gaussians.harmonics, directions)


def _project(
    gaussians: Gaussians, camera: Camera, dilation: float
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 2"], Float[Tensor, " n"]]:
    """Return means in pixels, covariances in pixels² (dilated) and camera depths in metres.

    The perspective map is linearised at the mean, held inside the widened image (Zwicker et al. 2001).
    """
    transform, K = camera.T_camera_world.to(gaussians.means), camera.K.to(gaussians.means)
    focal, center = K[[0, 1], [0, 1]], K[:2, 2]
    size = torch.tensor([camera.width, camera.height]).to(focal)
    local = gaussians.means @ transform[:3, :3].T + transform[:3, 3]
    z = local[:, 2:]
    tangents = local[:, :2] / z
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    limited = tangents.maximum(-center / focal - margin).minimum((size - center) / focal + margin)
    jacobian = torch.cat([torch.diag_embed(focal / z), -(focal * limited / z)[..., None]], -1)
    axes = matrix_from_quaternion(gaussians.rotations) * gaussians.scales[:, None, :]
    spread = jacobian @ transform[:3, :3] @ axes
    covariances = spread @ spread.mT + dilation * torch.eye(2).to(spread)
    return focal * tangents + center, covariances, z[:, 0]


def _composite_tile(splats: _Splats, left: int, top: int, camera: Camera) -> Float[Tensor, "h w 5"]:
    """Blend splats over the tile at a corner; return red, green, blue, alpha and sum(weight z)."""
    right, bottom = min(left + _TILE, camera.width), min(top + _TILE, camera.height)
    corners = torch.tensor([[left, top], [right, bottom]]).to(splats.means)
    touches = (splats.means + splats.radii > corners[0]) & (splats.means - splats.radii < corners[1])
    touches = touches.all(-1)
    y, x = torch.meshgrid(torch.arange(top, bottom), torch.arange(left, right), indexing="ij")
    pixels = torch.stack([x, y], -1).to(splats.means).flatten(0, 1) + 0.5
    offsets = splats.means[touches][:, None] - pixels
    squared = (offsets @ torch.linalg.inv(splats.covariances[touches]) * offsets).sum(-1)
    alphas = (splats.opacities[touches][:, None] * torch.exp(-0.5 * squared)).clamp_max(ALPHA_MAX)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas, 0)
    after = torch.cumprod(1 - alphas, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    # Transmittance only falls, so "below the minimum" marks the ending fragment and all behind it.
    weights = torch.where(after > TRANSMITTANCE_MIN, alphas * before, 0)
    features = splats.features[touches]
    color, depth = (weights.T @ features).split([3, 1], -1)
    return torch.cat([color, weights.sum(0)[:, None], depth], -1).unflatten(0, (bottom - top, right - left))
