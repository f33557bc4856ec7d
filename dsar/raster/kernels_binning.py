"""Numba kernels: which splats touch which blocks of which tile, front to back; where gradients meet again.

Splats are sorted by depth once for the whole image; dealing them out to the tiles in that order leaves every
tile's list sorted. A (tile, splat) pair is two numbers, the splat and the set of the tile's blocks that it
touches. The backward pass leaves sums with every pair; each splat knows the indices of its pairs: tiles write
without meeting, and sums run in one fixed order, so gradients are deterministic.

Several parts deal at once: each takes a stretch of the sorted splats, and counting first tells every part
where in each tile's list its own begin.
"""

import math

import numpy as np

from dsar.raster.conventions import ALPHA_MIN
from dsar.raster.jit import inlined, kernel
from dsar.raster.simd import LANES, broadcast, load, maximum, minimum, movemask, prefetch, sqrt
from dsar.raster.tiles import (
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    COLUMNS,
    PREFETCH_DISTANCE,
    RECORD_SIZE,
    STRIPS,
    TILE,
    TILE_BITS,
)

FIRST_ROWS = np.array([BLOCK_HEIGHT * strip + 0.5 for strip in range(LANES)], np.float32)
"""Centre of each strip's first pixel row, from the tile's top; lanes beyond the last strip are not used."""

_RADIX_BITS = 11
_RADIX = 1 << _RADIX_BITS
_LOG_ALPHA_MIN = np.float32(math.log2(ALPHA_MIN))
_ALL_STRIPS = np.uint32((1 << STRIPS) - 1)
_ZERO, _HALF = np.float32(0), np.float32(0.5)
# Pixels by which a splat's outline is widened, so that rounding never costs it a block.
_SLACK = np.float32(0.01)


@kernel
def sort_by_depth(records, bounds):
    """Return the indices of drawn splats front to back, ties by index (radix sort; depths are positive)."""
    n = len(bounds)
    ids, depths = np.empty(n, np.int32), np.empty(n, np.float32)
    count = 0
    for i in range(n):
        if bounds[i, 1] > 0:
            ids[count], depths[count] = i, records[i, 9]
            count += 1
    ids, keys = ids[:count], depths[:count].view(np.uint32)
    other_ids, other_keys = np.empty(count, np.int32), np.empty(count, np.uint32)
    for shift in (np.uint32(0), np.uint32(_RADIX_BITS), np.uint32(2 * _RADIX_BITS)):
        ends = np.zeros(_RADIX + 1, np.int32)
        for i in range(count):
            ends[((keys[i] >> shift) & np.uint32(_RADIX - 1)) + np.uint32(1)] += 1
        for digit in range(_RADIX):
            ends[digit + 1] += ends[digit]
        for i in range(count):
            digit = (keys[i] >> shift) & np.uint32(_RADIX - 1)
            other_keys[ends[digit]], other_ids[ends[digit]] = keys[i], ids[i]
            ends[digit] += 1
        keys, other_keys, ids, other_ids = other_keys, keys, other_ids, ids
    return ids


@inlined
def _prefetch_record(records, order, k):
    """Have the record of a splat that is due soon brought into the cache."""
    if k + PREFETCH_DISTANCE < len(order):
        prefetch(records, np.uint64(order[k + PREFETCH_DISTANCE]) * np.uint64(RECORD_SIZE))


@inlined
def _tile_span(bounds, i):
    """Return the first and end tile column and the first and end tile row that a splat touches."""
    last = np.int32(TILE - 1)
    return (
        bounds[i, 0] >> TILE_BITS,
        (bounds[i, 1] + last) >> TILE_BITS,
        bounds[i, 2] >> TILE_BITS,
        (bounds[i, 3] + last) >> TILE_BITS,
    )


@kernel
def count_intersections_part(part, parts, order, records, bounds, tiles_x, counts, tiles):
    """Count the splats that one part will deal to every tile (counts[part]), and the tiles of each splat."""
    n, flat, counts = len(order), records.reshape(-1), counts[part]
    counts[:] = 0
    for k in range(n * part // parts, n * (part + 1) // parts):
        _prefetch_record(flat, order, k)
        i = np.uint64(order[k])
        x0, x1, y0, y1 = _tile_span(bounds, i)
        tiles[i] = (x1 - x0) * (y1 - y0)
        for row in range(y0, y1):
            for tile in range(row * tiles_x + x0, row * tiles_x + x1):
                counts[np.uint64(tile)] += 1


@kernel
def prefix_sum(counts, tiles):
    """Turn counts into where each part begins in each tile's list.

    Returns:
        tile_offsets: [tiles + 1] where each tile's pairs start.
        splat_offsets: [n + 1] where each splat's pairs start.
    """
    tile_offsets, splat_offsets = np.empty(counts.shape[1] + 1, np.int32), np.empty(len(tiles) + 1, np.int32)
    total = np.int32(0)
    for tile in range(counts.shape[1]):
        tile_offsets[tile] = total
        for part in range(len(counts)):
            count = counts[part, tile]
            counts[part, tile] = total
            total += count
    tile_offsets[-1] = total
    splat_offsets[0] = 0
    for i in range(len(tiles)):
        splat_offsets[i + 1] = splat_offsets[i] + tiles[i]
    return tile_offsets, splat_offsets


@inlined
def _outline(records, i, top, first_rows):
    """Return the x where a splat's outline begins and ends in each strip of a tile, and where it meets them.

    On the outline alpha is ALPHA_MIN: log2 opacity - e1² - e2² = log2 ALPHA_MIN. At dy = mean y - pixel y it
    spans dx = (shear dy ± sqrt(log2 (opacity / ALPHA_MIN) - e2²)) / stretch, most of all where dy is ± lift.
    """
    height, limit, lift = records[i, 4], broadcast(records[i, 10]), broadcast(records[i, 11])
    log_ratio, width = records[i, 5] - _LOG_ALPHA_MIN, np.float32(1) / records[i, 2]
    highest = records[i, 1] - top - load(first_rows, np.uint64(0))
    lowest = highest - np.float32(BLOCK_HEIGHT - 1)
    touched = (lowest - _SLACK <= limit) & (highest + _SLACK >= -limit)
    low, high = maximum(lowest, -limit), minimum(highest, limit)
    right, left = minimum(maximum(lift, low), high), minimum(maximum(-lift, low), high)
    e2_right, e2_left = height * right, height * left
    reach_right = sqrt(maximum(log_ratio - e2_right * e2_right, broadcast(_ZERO)))
    reach_left = sqrt(maximum(log_ratio - e2_left * e2_left, broadcast(_ZERO)))
    begin = records[i, 0] - _SLACK - width * (records[i, 3] * right + reach_right)
    end = records[i, 0] + _SLACK - width * (records[i, 3] * left - reach_left)
    return begin, end, touched


@kernel
def emit_intersections_part(
    part, parts, order, records, bounds, tiles_x, first_rows, cursors, splat_offsets, pairs, pair_ids
):
    """Write one part's pairs into the tiles' lists, and their indices with the splats."""
    n, flat, cursors = len(order), records.reshape(-1), cursors[part]
    for k in range(n * part // parts, n * (part + 1) // parts):
        _prefetch_record(flat, order, k)
        i = np.uint64(order[k])
        x0, x1, y0, y1 = _tile_span(bounds, i)
        slot = splat_offsets[i]
        for row in range(y0, y1):
            begin, end, touched = _outline(records, i, np.float32(row * TILE), first_rows)
            for column in range(x0, x1):
                left = np.float32(column * TILE) + _HALF
                blocks = np.uint32(0)
                for block in range(COLUMNS):
                    first = left + np.float32(block * BLOCK_WIDTH)
                    meets = touched & (begin <= first + np.float32(BLOCK_WIDTH - 1)) & (end >= first)
                    blocks |= (movemask(meets) & _ALL_STRIPS) << np.uint32(block * STRIPS)
                tile = np.uint64(row * tiles_x + column)
                index = np.uint64(cursors[tile])
                cursors[tile] += 1
                pairs[index, 0], pairs[index, 1] = i, blocks
                pair_ids[slot] = index
                slot += 1


@kernel
def reduce_sums_part(part, parts, splat_offsets, pair_ids, pair_sums, sums):
    """Add up the sums of each splat's pairs."""
    n, flat = len(splat_offsets) - 1, pair_sums.reshape(-1)
    for i in range(n * part // parts, n * (part + 1) // parts):
        for k in range(sums.shape[1]):
            sums[i, k] = _ZERO
        for slot in range(splat_offsets[i], splat_offsets[i + 1]):
            if slot + PREFETCH_DISTANCE < len(pair_ids):
                prefetch(flat, np.uint64(pair_ids[slot + PREFETCH_DISTANCE]) * np.uint64(sums.shape[1]))
            for k in range(sums.shape[1]):
                sums[i, k] += pair_sums[pair_ids[slot], k]
