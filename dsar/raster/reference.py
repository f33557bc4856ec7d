"""The slow backend: the same image in plain torch, any dtype or device, differentiable in everything.

It is what the fast kernels are tested against, so it follows the formulas and not the machine.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dsar.geometry.harmonics import color_from_harmonics
from dsar.geometry.rotations import matrix_from_quaternion
from dsar.raster.contributors import find_first_hit_depth, find_largest_weight_id
from dsar.raster.conventions import (
    ALPHA_MAX,
    ALPHA_MIN,
    FRUSTUM_MARGIN,
    NEAR,
    TRANSMITTANCE_MIN,
)
from dsar.types import Camera, Contributors, Gaussians, RenderOutput

_TILE = 16


@dataclass(frozen=True)
class _Splats:
    """Gaussians on the image, front to back."""

    ids: Int[Tensor, " n"]
    means: Float[Tensor, "n 2"]
    """Pixels."""
    covariances: Float[Tensor, "n 2 2"]
    """Pixels², dilated."""
    opacities: Float[Tensor, " n"]
    features: Float[Tensor, "n 4"]
    """Red, green, blue, and camera depth in metres."""
    radii: Float[Tensor, "n 2"]
    """Half-width and half-height in pixels outside which alpha < ALPHA_MIN."""


@dataclass(frozen=True)
class _Tile:
    """What blending leaves of one tile."""

    image: Float[Tensor, "h w 5"]
    """Red, green, blue, alpha, and sum(weight z)."""
    median_depth: Float[Tensor, "h w"]
    pixels: Int[Tensor, " m"]
    """Pixel of each (splat, pixel) pair that was blended, flat in the whole image."""
    ids: Int[Tensor, " m"]
    weights: Float[Tensor, " m"]


def rasterize_reference(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Tensor, "3"] | None,
    dilation: float,
    antialiased: bool,
    outputs: Collection[str],
) -> RenderOutput:
    """Rasterise in plain torch: `dsar.raster.rasterize` without its checks, for any dtype and device."""
    splats = _project_splats(gaussians, camera, dilation, antialiased)
    rows = [
        [_blend_tile(splats, x, y, camera) for x in range(0, camera.width, _TILE)]
        for y in range(0, camera.height, _TILE)
    ]
    images = torch.cat([torch.cat([tile.image for tile in row], 1) for row in rows], 0)
    color, alpha, depth = images.split([3, 1, 1], -1)
    hit = alpha > 0
    depth = torch.where(hit, depth / torch.where(hit, alpha, 1), 0)
    if background is not None:
        color = color + (1 - alpha) * background
    culled = torch.tensor(len(gaussians) - len(splats.ids), device=color.device)
    extras: dict[str, Any] = {}
    if "median_depth" in outputs:
        extras["median_depth"] = torch.cat([torch.cat([t.median_depth for t in row], 1) for row in rows], 0)
    if {"first_hit_depth", "largest_weight_id", "contributors"} & set(outputs):
        contributors = _join_tiles([tile for row in rows for tile in row], camera)
        depths = splats.features.new_zeros(len(gaussians)).index_copy(0, splats.ids, splats.features[:, 3])
        compute = {
            "first_hit_depth": lambda: find_first_hit_depth(contributors, depths.detach()),
            "largest_weight_id": lambda: find_largest_weight_id(contributors),
            "contributors": lambda: contributors,
        }
        extras |= {name: compute[name]() for name in outputs if name in compute}
    return RenderOutput(color, alpha[..., 0], depth[..., 0], culled, **extras)


def _project_splats(gaussians: Gaussians, camera: Camera, dilation: float, antialiased: bool) -> _Splats:
    """Return those Gaussians that reach a pixel, front to back, ties in their own order."""
    drawable = _find_drawable(gaussians, camera, dilation, antialiased)
    # Selected before anything is computed: what is left out cannot send NaN back through a zero gradient.
    gaussians = gaussians.map(lambda values: values[drawable])
    means, covariances, depths, opacities = _project(gaussians, camera, dilation, antialiased)
    features = torch.cat([_shade(gaussians, camera), depths[:, None]], -1)
    radii = _radii(covariances, opacities)
    size = torch.tensor([camera.width, camera.height]).to(means)
    first = torch.ceil(means - radii - 0.5).clamp_min(0)
    end = torch.floor(means + radii + 0.5).minimum(size)
    order = depths.detach().argsort(stable=True)
    order = order[(first < end).all(-1)[order]]
    ids = drawable.nonzero()[:, 0]
    # A pixel more than needed: the blending itself cuts at ALPHA_MIN.
    return _Splats(*(v[order] for v in (ids, means, covariances, opacities, features, radii + 1)))


@torch.no_grad()
def _find_drawable(
    gaussians: Gaussians, camera: Camera, dilation: float, antialiased: bool
) -> Bool[Tensor, " n"]:
    """Return which Gaussians are in front, visible, of positive scale, and finite in all they project to."""
    means, covariances, depths, opacities = _project(gaussians, camera, dilation, antialiased)
    drawable = (depths > NEAR) & (opacities >= ALPHA_MIN) & (gaussians.scales > 0).all(-1)
    norms = gaussians.rotations.norm(dim=-1)
    drawable &= (norms > 0) & norms.isfinite() & depths.isfinite()
    # Harmonics and not colours, whose clamp would make 0 of minus infinity.
    for values in (means, covariances.flatten(1), opacities[:, None], gaussians.harmonics.flatten(1)):
        drawable &= values.isfinite().all(-1)
    return drawable


@torch.no_grad()
def _radii(covariances: Float[Tensor, "n 2 2"], opacities: Float[Tensor, " n"]) -> Float[Tensor, "n 2"]:
    """Return the half-width and half-height, pixels, outside which alpha < ALPHA_MIN."""
    cutoff = 2 * (opacities / ALPHA_MIN).log()
    return (cutoff[:, None] * covariances.diagonal(dim1=-2, dim2=-1)).sqrt()


def _shade(gaussians: Gaussians, camera: Camera) -> Float[Tensor, "n 3"]:
    """Return the colour of each Gaussian, seen from the camera."""
    center = camera.center.to(gaussians.means)
    directions = torch.nn.functional.normalize(gaussians.means - center, dim=-1)
    return color_from_harmonics(gaussians.harmonics, directions)


def _project(
    gaussians: Gaussians, camera: Camera, dilation: float, antialiased: bool
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 2"], Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Return means in pixels, covariances in pixels² (dilated), camera depths in metres, and opacities.

    The perspective map is linearised at the mean, held inside the widened image (Zwicker et al. 2001).
    Antialiased, dilation takes as much opacity as it adds area (Yu et al. 2024, Mip-Splatting).
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
    projected_axes = jacobian @ transform[:3, :3] @ axes
    covariances = projected_axes @ projected_axes.mT
    dilated = covariances + dilation * torch.eye(2).to(projected_axes)
    opacities = gaussians.opacities
    if antialiased:
        # The cross product keeps the digits of a thin splat's determinant.
        determinants = torch.linalg.cross(projected_axes[:, 0], projected_axes[:, 1]).square().sum(-1)
        opacities = opacities * (determinants / torch.linalg.det(dilated)).sqrt()
    return focal * tangents + center, dilated, z[:, 0], opacities


def _blend_tile(splats: _Splats, left: int, top: int, camera: Camera) -> _Tile:
    """Blend splats over the tile at a corner."""
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
    image = torch.cat([color, weights.sum(0)[:, None], depth], -1)
    blended = weights.detach() > 0
    pixel, splat = blended.T.nonzero(as_tuple=True)
    size = (bottom - top, right - left)
    return _Tile(
        image.unflatten(0, size),
        _last_depth(blended & (before > 0.5), features[:, 3].detach()).unflatten(0, size),
        (y * camera.width + x).to(pixel.device).flatten()[pixel],
        splats.ids[touches][splat],
        weights.detach()[splat, pixel],
    )


def _last_depth(candidates: Bool[Tensor, "n p"], depths: Float[Tensor, " n"]) -> Float[Tensor, " p"]:
    """Return the depth of each pixel's last candidate, 0 where there is none."""
    order = torch.arange(1, len(depths) + 1, device=depths.device)[:, None]
    last = torch.cat([order.new_zeros(1, candidates.shape[1]), candidates * order]).amax(0)
    return torch.cat([depths.new_zeros(1), depths])[last]


def _join_tiles(tiles: list[_Tile], camera: Camera) -> Contributors:
    """Return the tiles' pairs, pixel after pixel of the whole image."""
    pixels, ids, weights = (
        torch.cat([getattr(t, name) for t in tiles]) for name in ("pixels", "ids", "weights")
    )
    counts = torch.bincount(pixels, minlength=camera.width * camera.height)
    order = pixels.argsort(stable=True)
    return Contributors(counts.unflatten(0, (camera.height, camera.width)), ids[order], weights[order])
