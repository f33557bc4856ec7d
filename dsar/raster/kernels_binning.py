"""Numba kernels: which splats touch which tile, front to back, and where their gradients meet again.

Splats are sorted by depth once for the whole image; dealing them out to the tiles in that order leaves every
tile's list sorted. Each (tile, splat) pair owns one slot of the backward pass, and the slots of a splat lie
together: tiles write without meeting, and the sum runs in one fixed order, so gradients are deterministic.
"""

import numpy as np

from dsar.raster.jit import inlined, kernel

_RADIX_BITS = 11
_RADIX = 1 << _RADIX_BITS


@inlined
def _sort_by_depth(records, bounds):
    """Return the indices of visible splats front to back, ties by index (radix sort; depths are positive)."""
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


@kernel
def bin_splats(records, bounds, tiles_x, tiles_y, tile_width, tile_height):
    """Return the splats of every tile, front to back.

    Returns:
        tile_starts: [tiles + 1] where each tile's list starts in `entries`.
        entries: splat index of every (tile, splat) pair.
        slots: the pair's place in the slot buffer of the backward pass.
        slot_starts: [n + 1] where each splat's slots start.
    """
    n = len(bounds)
    order = _sort_by_depth(records, bounds)
    tile_starts, slot_starts = np.zeros(tiles_x * tiles_y + 1, np.int32), np.zeros(n + 1, np.int32)
    spans = np.empty((n, 4), np.int32)
    for i in range(n):
        if bounds[i, 1] > 0:
            spans[i, 0], spans[i, 1] = bounds[i, 0] // tile_width, (bounds[i, 1] - 1) // tile_width + 1
            spans[i, 2], spans[i, 3] = bounds[i, 2] // tile_height, (bounds[i, 3] - 1) // tile_height + 1
            for row in range(spans[i, 2], spans[i, 3]):
                for column in range(spans[i, 0], spans[i, 1]):
                    tile_starts[row * tiles_x + column + 1] += 1
            slot_starts[i + 1] = (spans[i, 1] - spans[i, 0]) * (spans[i, 3] - spans[i, 2])
        slot_starts[i + 1] += slot_starts[i]
    for tile in range(tiles_x * tiles_y):
        tile_starts[tile + 1] += tile_starts[tile]
    entries, slots = np.empty(slot_starts[n], np.int32), np.empty(slot_starts[n], np.int32)
    cursors = tile_starts[:-1].copy()
    for i in order:
        slot = slot_starts[i]
        for row in range(spans[i, 2], spans[i, 3]):
            for column in range(spans[i, 0], spans[i, 1]):
                position = cursors[row * tiles_x + column]
                cursors[row * tiles_x + column] = position + 1
                entries[position], slots[position] = i, slot
                slot += 1
    return tile_starts, entries, slots, slot_starts


@kernel
def gather_slots_part(part, parts, slot_starts, slot_sums, sums):
    """Add up each splat's slots."""
    n = len(slot_starts) - 1
    for i in range(n * part // parts, n * (part + 1) // parts):
        for k in range(sums.shape[1]):
            sums[i, k] = np.float32(0)
        for slot in range(slot_starts[i], slot_starts[i + 1]):
            for k in range(sums.shape[1]):
                sums[i, k] += slot_sums[slot, k]
