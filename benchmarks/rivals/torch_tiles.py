"""The rasteriser that one would write in plain torch: sorted and binned once, then tile after tile.

It draws the image of `dsar.raster` (colour only), with gradients from autograd.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from dsar.geometry.harmonics import color_from_harmonics
from dsar.geometry.rotations import matrix_from_quaternion
from dsar.raster.conventions import ALPHA_MAX, ALPHA_MIN, EPS_2D, FRUSTUM_MARGIN, NEAR, TRANSMITTANCE_MIN
from dsar.types import Camera, Gaussians
from rivals import TorchScene

TILE = 16


@dataclass(frozen=True)
class Splats:
    """Gaussians on the image, front to back."""

    means: Tensor
    """[n, 2] pixels."""
    conics: Tensor
    """[n, 3] inverse covariances: xx, xy, yy, per pixel²."""
    opacities: Tensor
    """[n]."""
    colors: Tensor
    """[n, 3]."""
    radii: Tensor
    """[n, 2] pixels beyond which a splat is fainter than ALPHA_MIN."""


def prepare(gaussians: Gaussians, camera: Camera, threads: int) -> TorchScene:
    """Return the scene as this rasteriser draws it."""
    return TorchScene(render, gaussians, camera)


def render(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return the colour image [h, w, 3]."""
    splats = project(gaussians, camera)
    owners, counts = bin_splats(splats, camera)
    table = torch.cat([splats.means, splats.conics, splats.opacities[:, None], splats.colors], -1)
    # Gathered for all tiles at once: selecting tile by tile, backward would fill a whole table for each.
    parts = table.index_select(0, owners).split(counts.tolist())
    row, column = torch.meshgrid(torch.arange(TILE) + 0.5, torch.arange(TILE) + 0.5, indexing="ij")
    tiles_x, tiles_y = _count_tiles(camera)
    tiles = [
        _composite(part, column.flatten() + TILE * (tile % tiles_x), row.flatten() + TILE * (tile // tiles_x))
        for tile, part in enumerate(parts)
    ]
    image = torch.stack(tiles).view(tiles_y, tiles_x, TILE, TILE, 3).transpose(1, 2)
    return image.reshape(tiles_y * TILE, tiles_x * TILE, 3)[: camera.height, : camera.width]


def project(gaussians: Gaussians, camera: Camera) -> Splats:
    """Return the visible Gaussians on the image, front to back, covariances without a 3 x 3 product."""
    rotation, translation = camera.T_camera_world[:3, :3], camera.T_camera_world[:3, 3]
    with torch.no_grad():
        depths = gaussians.means @ rotation[2] + translation[2]
        visible = ((depths > NEAR) & (gaussians.opacities >= ALPHA_MIN)).nonzero()[:, 0]
        order = visible[depths[visible].argsort(stable=True)]
    gaussians = gaussians.map(lambda values: values.index_select(0, order))
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    x, y, z = (gaussians.means @ rotation.T + translation).unbind(-1)
    slope_x, slope_y = x / z, y / z
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * camera.width / fx, FRUSTUM_MARGIN * 0.5 * camera.height / fy
    held_x = slope_x.clamp(-cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    held_y = slope_y.clamp(-cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    axes = rotation @ (matrix_from_quaternion(gaussians.rotations) * gaussians.scales[:, None, :])
    along_x = (fx / z)[:, None] * (axes[:, 0] - held_x[:, None] * axes[:, 2])
    along_y = (fy / z)[:, None] * (axes[:, 1] - held_y[:, None] * axes[:, 2])
    xx = along_x.square().sum(-1) + EPS_2D
    yy = along_y.square().sum(-1) + EPS_2D
    xy = (along_x * along_y).sum(-1)
    conics = torch.stack([yy, -xy, xx], -1) / (xx * yy - xy.square())[:, None]
    directions = torch.nn.functional.normalize(gaussians.means - camera.center, dim=-1)
    reach = 2 * (gaussians.opacities.detach() / ALPHA_MIN).log()
    return Splats(
        torch.stack([fx * slope_x + cx, fy * slope_y + cy], -1),
        conics,
        gaussians.opacities,
        color_from_harmonics(gaussians.harmonics, directions),
        (reach[:, None] * torch.stack([xx, yy], -1).detach()).sqrt(),
    )


@torch.no_grad()
def bin_splats(splats: Splats, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return which splats each tile draws, tile after tile and front to back, and how many each draws."""
    tiles_x, tiles_y = _count_tiles(camera)
    last_tile = torch.tensor([tiles_x - 1, tiles_y - 1])
    first = ((splats.means - splats.radii) / TILE).floor().clamp_min(0).long()
    last = ((splats.means + splats.radii) / TILE).floor().long().minimum(last_tile)
    extent = (last - first + 1).clamp_min(0)
    copies = extent.prod(-1)
    owners = torch.repeat_interleave(copies)
    nth = torch.arange(len(owners)) - (copies.cumsum(0) - copies)[owners]
    x = first[owners, 0] + nth % extent[owners, 0]
    y = first[owners, 1] + nth // extent[owners, 0]
    tiles = y * tiles_x + x
    return owners[tiles.argsort(stable=True)], tiles.bincount(minlength=tiles_x * tiles_y)


def _composite(part: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Blend one tile's splats [n, 9] over its pixel centres [p]; return the colours [p, 3]."""
    mean_x, mean_y, xx, xy, yy, opacity = part[:, :6].T[..., None]
    dx, dy = mean_x - x, mean_y - y
    falloff = torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
    alphas = (opacity * falloff).clamp_max(ALPHA_MAX)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas, 0)
    after = torch.cumprod(1 - alphas, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weights = torch.where(after > TRANSMITTANCE_MIN, alphas * before, 0)
    return weights.T @ part[:, 6:]


def _count_tiles(camera: Camera) -> tuple[int, int]:
    """Return how many tiles an image is wide and high."""
    return -(-camera.width // TILE), -(-camera.height // TILE)
