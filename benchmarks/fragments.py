"""How much there is to draw: counted once per scene, the same for every rasteriser."""

from dataclasses import dataclass

import numba
import numpy as np
import torch
from rivals.torch_tiles import TILE, bin_splats, project

from dsar.raster.conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from dsar.types import Camera, Gaussians


@dataclass(frozen=True)
class Work:
    """What one image of a scene asks for."""

    fragments: int
    """Pairs of a pixel and a Gaussian with alpha >= 1/255 there, hidden ones included."""
    blended: int
    """Those of them that a pixel still blends before its transmittance is used up."""
    tile_pairs: int
    """Pairs of a pixel and a Gaussian whose box touches the pixel's 16 x 16 tile."""


@torch.no_grad()
def count_work(gaussians: Gaussians, camera: Camera) -> Work:
    """Count the fragments of a scene."""
    splats = project(gaussians, camera)
    owners, _ = bin_splats(splats, camera)
    fragments, blended = _count_fragments(
        *(getattr(splats, name).numpy() for name in ("means", "conics", "opacities", "radii")),
        np.ones((camera.height, camera.width), np.float32),
    )
    return Work(fragments, blended, len(owners) * TILE * TILE)


@numba.njit(error_model="numpy")
def _count_fragments(means, conics, opacities, radii, transmittances):
    """Return how many fragments splats (front to back) have, and how many of them are blended."""
    height, width = transmittances.shape
    fragments = blended = 0
    for i in range(len(means)):
        left, right = means[i, 0] - radii[i, 0], means[i, 0] + radii[i, 0]
        top, bottom = means[i, 1] - radii[i, 1], means[i, 1] + radii[i, 1]
        for row in range(max(0, int(top)), min(height, int(bottom) + 1)):
            dy = means[i, 1] - row - 0.5
            for column in range(max(0, int(left)), min(width, int(right) + 1)):
                dx = means[i, 0] - column - 0.5
                squared = conics[i, 0] * dx * dx + 2 * conics[i, 1] * dx * dy + conics[i, 2] * dy * dy
                alpha = min(ALPHA_MAX, opacities[i] * np.exp(-0.5 * squared))
                if alpha < ALPHA_MIN:
                    continue
                fragments += 1
                after = transmittances[row, column] * (1 - alpha)
                if after > TRANSMITTANCE_MIN:
                    blended += 1
                # What is left stays below the minimum, so this pixel blends nothing more.
                transmittances[row, column] = after
    return fragments, blended
