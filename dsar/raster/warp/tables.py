# pyright: reportInvalidTypeForm=false
"""What the kernels know of a batch: whose Gaussians each view shows, and where its part of every array lies.

The images of all views lie one after another in flat arrays, row by row, and so do their tiles, tile row by
tile row. An *instance* is a Gaussian in a view; those of a view lie one after another in the set's order.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import torch
import warp as wp
from jaxtyping import Float, Int32
from torch import Tensor

from dsar.types import Camera

TILE = wp.constant(16)
"""Pixels along a tile's side."""
# Columns of the table of views.
WIDTH, HEIGHT, TILES_X, FIRST_TILE, FIRST_PIXEL, FIRST_INSTANCE, FIRST_GAUSSIAN = map(wp.constant, range(7))
# Columns of the table of cameras: rotation (row-major 9), translation (3), fx, fy, cx, cy, and the camera's
# centre in the world (3).
ROTATION, TRANSLATION, FOCAL, PRINCIPAL, CENTER = map(wp.constant, (0, 9, 12, 14, 16))


@dataclass(frozen=True)
class Tables:
    """The layout of a batch, on the device."""

    sizes: tuple[tuple[int, int], ...]
    """Height and width of each view, pixels."""
    counts: tuple[int, ...]
    """Gaussians of each view."""
    gaussians: int
    """Of all sets."""
    tiles: int
    """Of all views."""
    views: Int32[Tensor, "v 7"]
    """See the columns above."""
    tile_ends: Int32[Tensor, " v"]
    """End of each view's tiles."""
    set_ends: Int32[Tensor, " s"]
    """End of each set's Gaussians."""
    first_views: Int32[Tensor, " s1"]
    """First view of each set, and the number of views."""
    cameras: Float[Tensor, "v 19"]
    """See the columns above."""

    @property
    def instances(self) -> int:
        """The number of Gaussians in all views."""
        return sum(self.counts)

    @cached_property
    def pixels(self) -> list[int]:
        """The number of each view's pixels."""
        return [height * width for height, width in self.sizes]


def make_tables(
    counts: Sequence[int], cameras: Sequence[Sequence[Camera]], device: torch.device
) -> Tables:
    """Lay out a batch: sets of so many Gaussians, each seen by its cameras."""
    flat = [camera for group in cameras for camera in group]
    owners = [index for index, group in enumerate(cameras) for _ in group]
    starts = [0, *accumulate(counts)]
    view_counts = [counts[owner] for owner in owners]
    grids = [(-(-camera.width // TILE), -(-camera.height // TILE)) for camera in flat]
    rows = zip(
        [camera.width for camera in flat],
        [camera.height for camera in flat],
        [across for across, _ in grids],
        accumulate((across * down for across, down in grids), initial=0),
        accumulate((camera.width * camera.height for camera in flat), initial=0),
        accumulate(view_counts, initial=0),
        [starts[owner] for owner in owners],
    )
    views = [value for row in rows for value in row]
    tile_ends = list(accumulate(across * down for across, down in grids))
    first_views = list(accumulate((len(group) for group in cameras), initial=0))
    # In one piece, so that one copy brings all to the device.
    parts = [views, tile_ends, starts[1:], first_views]
    packed = torch.tensor([value for part in parts for value in part], dtype=torch.int32).to(device)
    split = packed.split([len(part) for part in parts])
    return Tables(
        tuple((camera.height, camera.width) for camera in flat),
        tuple(view_counts),
        starts[-1],
        tile_ends[-1],
        split[0].view(len(flat), 7),
        *split[1:],
        torch.stack([_pack_camera(camera) for camera in flat]).to(device),
    )


def _pack_camera(camera: Camera) -> Float[Tensor, "19"]:
    """Return a camera as the kernels take it, in main memory."""
    transform, K = (t.detach().double().cpu() for t in (camera.T_camera_world, camera.K))
    rotation, translation = transform[:3, :3], transform[:3, 3]
    intrinsics = K[[0, 1, 0, 1], [0, 1, 2, 2]]
    return torch.cat([rotation.flatten(), translation, intrinsics, -rotation.T @ translation]).float()
