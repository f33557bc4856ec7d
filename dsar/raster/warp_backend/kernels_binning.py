"""Warp kernels: the pairs of a tile and a splat that touches it, and the sums over a splat's pairs."""

import math
from typing import no_type_check

import warp as wp  # pyright: ignore[reportMissingImports]  # optional

from dsar.raster.conventions import ALPHA_MIN
from dsar.raster.warp_backend.compiling import func, kernel
from dsar.raster.warp_backend.kernels_projection import Record
from dsar.raster.warp_backend.tables import FIRST_TILE, HEIGHT, TILE, TILES_X, WIDTH

_LOG_ALPHA_MIN = wp.constant(math.log(ALPHA_MIN))
_SLACK = wp.constant(1e-4)
"""Added to the exponent at which a splat ends, so that rounding loses no pixel."""
_MARGIN = wp.constant(1e-4)
"""Pixels by which a chord is longer on either side, for the same reason."""


@func
@no_type_check
def pixel_index(coordinate: float, size: int):
    """Return the first pixel whose centre is at or beyond a coordinate, held to 0..size."""
    return int(wp.clamp(wp.ceil(coordinate - 0.5), 0.0, float(size)))


@func
@no_type_check
def pixel_end(coordinate: float, size: int):
    """Return the end of the pixels whose centres are at or before a coordinate, held to 0..size."""
    return int(wp.clamp(wp.floor(coordinate + 0.5), 0.0, float(size)))


@func
@no_type_check
def half_chord(dy: float, reach: float, stretch: float, height: float):
    """Return half the length of the outline's chord at a height above the mean, pixels."""
    rest = wp.max(reach - height * height * dy * dy, 0.0)
    return wp.sqrt(rest) / stretch


@kernel
@no_type_check
def list_pairs(
    drawable: wp.array[int], records: wp.array[Record], instance_bounds: wp.array[int],
    views: wp.array2d[int], pair_ends: wp.array[wp.int64], counts: wp.array[int],
    keys: wp.array[wp.int64], owners: wp.array[int],
):  # fmt: skip
    """Count the tiles that each instance touches; if `keys` is not empty, list them instead.

    What has no pixel in its bounding box is marked as not drawable. Of each row of tiles those are listed
    that the outline reaches.

    Keys sort by tile, then by depth. One kernel does both, because another might round otherwise and find
    another number.
    """
    i = wp.tid()
    count = int(0)
    if drawable[i] != 0:
        view = wp.lower_bound(instance_bounds, i + 1) - 1
        r = records[i]
        x, y, stretch, shear, height = r[0], r[1], r[2], r[3], r[4]
        reach = r[5] - _LOG_ALPHA_MIN + _SLACK
        tiles_x = views[view, TILES_X]
        # Where the outline is widest, and its half-height; dy is the mean's minus the pixel's.
        slope = shear / height
        half_height = wp.sqrt(reach) / height
        spread = wp.sqrt(1.0 + slope * slope)
        half_width, lift = wp.sqrt(reach) * spread / stretch, half_height * slope / spread
        y0, y1 = (
            pixel_index(y - half_height, views[view, HEIGHT]),
            pixel_end(y + half_height, views[view, HEIGHT]),
        )
        x0, x1 = (
            pixel_index(x - half_width, views[view, WIDTH]),
            pixel_end(x + half_width, views[view, WIDTH]),
        )
        end = (y1 + TILE - 1) // TILE
        if x0 >= x1 or y0 >= y1:
            drawable[i] = 0
            end = y0 // TILE
        place = int(0)
        if keys.shape[0] > 0 and i > 0:
            place = int(pair_ends[i - 1])
        for tile_y in range(y0 // TILE, end):
            # The rows of the tile that the splat reaches, as dy.
            high = y - (float(wp.max(y0, tile_y * TILE)) + 0.5)
            low = y - (float(wp.min(y1, tile_y * TILE + TILE)) - 0.5)
            right, left = wp.clamp(lift, low, high), wp.clamp(-lift, low, high)
            # dx = mean - pixel lies within shear dy / stretch +- the chord.
            dx_high = shear * right / stretch + half_chord(right, reach, stretch, height)
            dx_low = shear * left / stretch - half_chord(left, reach, stretch, height)
            from_x = pixel_index(x - dx_high - _MARGIN, views[view, WIDTH])
            to_x = pixel_end(x - dx_low + _MARGIN, views[view, WIDTH])
            if from_x < to_x:
                for tile_x in range(from_x // TILE, (to_x + TILE - 1) // TILE):
                    if keys.shape[0] > 0:
                        tile = views[view, FIRST_TILE] + tile_y * tiles_x + tile_x
                        # Depths are positive, and such floats sort like their bits.
                        depth = wp.int64(wp.cast(r[9], wp.int32))
                        keys[place + count] = (wp.int64(tile) << wp.int64(32)) | depth
                        owners[place + count] = i
                    count += 1
    if keys.shape[0] == 0:
        counts[i] = count


@kernel
@no_type_check
def sum_pairs(pair_ends: wp.array[wp.int64], pair_sums: wp.array[Record], sums: wp.array[Record]):
    """Add up what the pairs of each instance hold, always in the same order."""
    i = wp.tid()
    first = int(0)
    if i > 0:
        first = int(pair_ends[i - 1])
    total = Record()
    for k in range(first, int(pair_ends[i])):
        total += pair_sums[k]
    sums[i] = total
