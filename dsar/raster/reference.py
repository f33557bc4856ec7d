"""The slow backend: the same image in plain torch, any dtype or device, differentiable in everything.

It is what the fast kernels are tested against, so it follows the formulas and not the machine.
"""

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


def rasterize_reference(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Tensor, "3"] | None = None,
    directions: Float[Tensor, "n 3"] | None = None,
) -> RenderOutput:
    """Rasterise in plain torch: `dsar.raster.rasterize` without its checks, for any dtype and device."""
    if directions is None:
        center = camera.center.to(gaussians.means)
        directions = torch.nn.functional.normalize(gaussians.means - center, dim=-1)
    drawable = _find_drawable(gaussians, camera, directions)
    gaussians, directions = gaussians.map(lambda values: values[drawable]), directions[drawable]
    means, covariances, depths = _project(gaussians, camera)
    radii = _measure_radii(covariances, gaussians.opacities)
    order = depths.detach().argsort(stable=True)
    colors = color_from_harmonics(gaussians.harmonics, directions)
    splats = (means, covariances, gaussians.opacities, torch.cat([colors, depths[:, None]], -1), radii)
    splats = tuple(values[order] for values in splats)
    rows = [
        torch.cat([_composite_tile(*splats, x, y, camera) for x in range(0, camera.width, _TILE)], 1)
        for y in range(0, camera.height, _TILE)
    ]
    color, alpha, depth = torch.cat(rows, 0).split([3, 1, 1], -1)
    hit = alpha > 0
    depth = torch.where(hit, depth / torch.where(hit, alpha, 1), 0)
    if background is not None:
        color = color + (1 - alpha) * background
    return RenderOutput(color, alpha[..., 0], depth[..., 0])


def _find_drawable(
    gaussians: Gaussians, camera: Camera, directions: Float[Tensor, "n 3"]
) -> Bool[Tensor, " n"]:
    """Return which Gaussians are in front, visible, with positive scales, and finite with all they project to."""
    with torch.no_grad():
        _, _, depths = _project(gaussians, camera)
        drawable = (depths > NEAR) & (gaussians.opacities >= ALPHA_MIN) & (gaussians.scales > 0).all(-1)
        drawable &= gaussians.rotations.norm(dim=-1) > 0
        means, covariances, _ = _project(gaussians, camera)
        colors = color_from_harmonics(gaussians.harmonics, directions)
        for values in (means, covariances.flatten(1), gaussians.opacities[:, None], colors):
            drawable &= values.isfinite().all(-1)
    return drawable


def _project(
    gaussians: Gaussians, camera: Camera
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 2"], Float[Tensor, " n"]]:
    """Return means in pixels, covariances in pixels² (dilated by EPS_2D) and camera depths in metres.

    The perspective map is linearised at the mean (Zwicker et al. 2001), its tangents clamped to the widened image.
    """
    transform, K = camera.T_camera_world.to(gaussians.means), camera.K.to(gaussians.means)
    focal, center = K[[0, 1], [0, 1]], K[:2, 2]
    size = torch.tensor([camera.width, camera.height]).to(focal)
    local = gaussians.means @ transform[:3, :3].T + transform[:3, 3]
    z = local[:, 2:]
    tangents = local[:, :2] / z
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    limited = tangents.maximum(-center / focal - margin).minimum((size - center) / focal + margin)
    jacobian = torch.cat([torch.diag_embed((focal / z)), -(focal * limited / z)[..., None]], -1)
    axes = matrix_from_quaternion(gaussians.rotations) * gaussians.scales[:, None, :]
    spread = jacobian @ transform[:3, :3] @ axes
    covariances = spread @ spread.mT + EPS_2D * torch.eye(2).to(spread)
    return focal * tangents + center, covariances, z[:, 0]


def _measure_radii(
    covariances: Float[Tensor, "n 2 2"], opacities: Float[Tensor, " n"]
) -> Float[Tensor, "n 2"]:
    """Return the half-width and half-height in pixels outside which alpha < ALPHA_MIN."""
    reach = 2 * (opacities.detach() / ALPHA_MIN).log().clamp_min(0)
    variances = covariances.detach().diagonal(dim1=-2, dim2=-1)
    return (reach[:, None] * variances).sqrt() + 1


def _composite_tile(
    means: Float[Tensor, "n 2"],
    covariances: Float[Tensor, "n 2 2"],
    opacities: Float[Tensor, " n"],
    features: Float[Tensor, "n 4"],
    radii: Float[Tensor, "n 2"],
    left: int,
    top: int,
    camera: Camera,
) -> Float[Tensor, "h w 5"]:
    """Blend depth-sorted splats over one tile; return red, green, blue, alpha and sum(weight z)."""
    right, bottom = min(left + _TILE, camera.width), min(top + _TILE, camera.height)
    corners = torch.tensor([[left, top], [right, bottom]]).to(means)
    touches = ((means + radii > corners[0]) & (means - radii < corners[1])).all(-1)
    y, x = torch.meshgrid(torch.arange(top, bottom), torch.arange(left, right), indexing="ij")
    pixels = torch.stack([x, y], -1).to(means).flatten(0, 1) + 0.5
    offsets = means[touches][:, None] - pixels
    whitened = (offsets @ torch.linalg.inv(covariances[touches])) * offsets
    alphas = (opacities[touches][:, None] * torch.exp(-0.5 * whitened.sum(-1))).clamp_max(ALPHA_MAX)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas, 0)
    after = torch.cumprod(1 - alphas, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    # Transmittance only falls, so "below the minimum" marks the ending fragment and all behind it.
    weights = torch.where(after > TRANSMITTANCE_MIN, alphas * before, 0)
    blended = torch.cat([features[touches], torch.ones_like(features[touches][:, :1])], -1)
    color, depth, alpha = (weights.T @ blended).split([3, 1, 1], -1)
    return torch.cat([color, alpha, depth], -1).unflatten(0, (bottom - top, right - left))
