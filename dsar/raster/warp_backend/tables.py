"""What the kernels know of a batch: whose Gaussians each view shows, and where its part of every array lies.

The images of all views lie one after another in flat arrays, row by row, and so do their tiles, tile row by
tile row. An *instance* is a Gaussian in a view; those of a view lie one after another in the set's order.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import torch
import warp as wp  # pyright: ignore[reportMissingImports]  # optional
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
    gaussians: int
    """Of all sets."""
    instances: int
    """Of all views, likewise tiles."""
    tiles: int
    views: Int32[Tensor, "v 7"]
    """See the columns above."""
    tile_ends: Int32[Tensor, " v"]
    """End of each view's tiles."""
    pixel_bounds: Int32[Tensor, " v1"]
    """Where each view's pixels start, and the number of all."""
    instance_bounds: Int32[Tensor, " v1"]
    """Where each view's instances start, and the number of all."""
    set_ends: Int32[Tensor, " s"]
    """End of each set's Gaussians."""
    first_views: Int32[Tensor, " s1"]
    """First view of each set, and the number of views."""
    cameras: Float[Tensor, "v 19"]
    """See the columns above."""

    @cached_property
    def pixels(self) -> list[int]:
        """The number of each view's pixels."""
        return [height * width for height, width in self.sizes]


def make_tables(counts: Sequence[int], cameras: Sequence[Sequence[Camera]], device: torch.device) -> Tables:
    """Lay out a batch: sets of so many Gaussians, each seen by its cameras."""
    flat = [camera for group in cameras for camera in group]
    owners = [index for index, group in enumerate(cameras) for _ in group]
    grids = [(-(-camera.width // TILE), -(-camera.height // TILE)) for camera in flat]
    sets = _bounds(counts)
    instances = _bounds([counts[owner] for owner in owners])
    pixels = _bounds([camera.width * camera.height for camera in flat])
    tiles = _bounds([across * down for across, down in grids])
    # One column each, in the order of the constants above.
    columns = (
        [camera.width for camera in flat],
        [camera.height for camera in flat],
        [across for across, _ in grids],
        tiles[:-1],
        pixels[:-1],
        instances[:-1],
        [sets[owner] for owner in owners],
    )
    views = [value for row in zip(*columns, strict=True) for value in row]
    parts = [views, tiles[1:], pixels, instances, sets[1:], _bounds([len(group) for group in cameras])]
    # In one piece, so that one copy brings all to the device.
    packed = torch.tensor([value for part in parts for value in part], dtype=torch.int32).to(device)
    table, tile_ends, pixel_bounds, instance_bounds, set_ends, first_views = packed.split(
        [len(part) for part in parts]
    )
    return Tables(
        sizes=tuple((camera.height, camera.width) for camera in flat),
        gaussians=sets[-1],
        instances=instances[-1],
        tiles=tiles[-1],
        views=table.view(len(flat), len(columns)),
        tile_ends=tile_ends,
        pixel_bounds=pixel_bounds,
        instance_bounds=instance_bounds,
        set_ends=set_ends,
        first_views=first_views,
        cameras=torch.tensor([_pack_camera(camera) for camera in flat], dtype=torch.float32).to(device),
    )


def _bounds(counts: Sequence[int]) -> list[int]:
    """Return where each of consecutive parts starts, and where the last one ends."""
    return list(accumulate(counts, initial=0))


def _pack_camera(camera: Camera) -> list[float]:
    """Return a camera's row of the table."""
    # As lists: on so few numbers Python is faster than torch.
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    rows = camera.T_camera_world.tolist()[:3]
    rotation = [value for row in rows for value in row[:3]]
    translation = [row[3] for row in rows]
    center = [-sum(row[axis] * row[3] for row in rows) for axis in range(3)]
    return [*rotation, *translation, fx, fy, cx, cy, *center]
