"""Numba kernel of the auxiliary pass: what is known of a pixel besides its colour, alpha and expected depth.

It blends the splats once more, for the median depth, the first hit's depth, the largest weight and its splat,
and the list of all splats of every pixel.
"""

import numpy as np

from dsar.raster.jit import inlined, kernel
from dsar.raster.simd import LANES, broadcast, count_trailing_zeros, load, movemask, select, store
from dsar.raster.tile_state import (
    CHECK_INTERVAL,
    blend,
    find_active,
    init_tile,
    new_state,
    pixel_start,
    prefetch_record,
    splat_in_tile,
)
from dsar.raster.tiles import BLOCKS, TILE

# Planes of a block: depth at half transmittance, how many splats were blended, depth of the first, and the
# largest weight with its splat (a number that is exact up to 16 million).
_MEDIAN, _COUNT, _FIRST_HIT, _LARGEST_WEIGHT, _LARGEST_ID = (
    np.uint64(plane * LANES) for plane in (3, 4, 5, 6, 7)
)
_AUXILIARY = np.uint64(8 * LANES)
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@inlined
def _accumulate_auxiliary(state, start, i, z, weight, before):
    """Remember of a splat what is asked about a block's pixels."""
    blended = weight > _ZERO
    z = broadcast(z)
    median, first_hit = load(state, start + _MEDIAN), load(state, start + _FIRST_HIT)
    count = load(state, start + _COUNT)
    store(state, start + _MEDIAN, select(blended & (before > _HALF), z, median))
    store(state, start + _FIRST_HIT, select(blended & (count < _HALF), z, first_hit))
    store(state, start + _COUNT, count + select(blended, broadcast(_ONE), broadcast(_ZERO)))
    largest, largest_id = load(state, start + _LARGEST_WEIGHT), load(state, start + _LARGEST_ID)
    heavier = weight > largest
    store(state, start + _LARGEST_WEIGHT, select(heavier, weight, largest))
    store(state, start + _LARGEST_ID, select(heavier, broadcast(np.float32(i)), largest_id))


@kernel
def composite_auxiliary_part(
    part, parts, records, tile_offsets, pairs, tiles_x, starts,
    medians, first_hits, largest_id, counts, ids, weights,
):  # fmt: skip
    """Blend every parts-th tile once more, for depths, the largest weight and how many each pixel has.

    If `ids` is not empty, write each pixel's splats and weights from its start on. One kernel does both,
    because another might round otherwise, and find another number of splats.
    """
    height, width = medians.shape
    state, flat = new_state(_AUXILIARY), records.reshape(-1)
    lanes, cursors = np.empty(LANES, np.float32), np.zeros(BLOCKS * LANES, np.int64)
    collecting = len(ids) > 0
    for tile in range(part, len(tile_offsets) - 1, parts):
        left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
        init_tile(state, _AUXILIARY, width - left, height - top)
        for block in range(np.uint64(BLOCKS)):
            for plane in (_MEDIAN, _COUNT, _FIRST_HIT, _LARGEST_WEIGHT):
                store(state, block * _AUXILIARY + plane, broadcast(_ZERO))
            store(state, block * _AUXILIARY + _LARGEST_ID, broadcast(-_ONE))
        if collecting:
            for y in range(min(TILE, height - top)):
                for x in range(min(TILE, width - left)):
                    cursors[pixel_start(x, y, np.uint64(LANES))] = starts[(top + y) * width + left + x]
        active = find_active(state, _AUXILIARY)
        first, end = np.uint64(tile_offsets[tile]), np.uint64(tile_offsets[tile + 1])
        for index in range(first, end):
            if (index - first) % np.uint64(CHECK_INTERVAL) == np.uint64(CHECK_INTERVAL - 1):
                active = find_active(state, _AUXILIARY)
                if active == np.uint32(0):
                    break
            prefetch_record(flat, pairs, index)
            blocks, i = np.uint32(pairs[index, 1]) & active, np.uint64(pairs[index, 0])
            splat = splat_in_tile(records, i, left, top)
            while blocks != np.uint32(0):
                block = count_trailing_zeros(blocks)
                start = block * _AUXILIARY
                blocks &= blocks - np.uint32(1)
                _, _, _, weight, before = blend(state, start, *splat)
                blended = weight > _ZERO
                _accumulate_auxiliary(state, start, i, records[i, 9], weight, before)
                store(lanes, np.uint64(0), weight)
                hits = movemask(blended) if collecting else np.uint32(0)
                while hits != np.uint32(0):
                    lane = count_trailing_zeros(hits)
                    hits &= hits - np.uint32(1)
                    pixel = block * np.uint64(LANES) + lane
                    ids[cursors[pixel]], weights[cursors[pixel]] = i, lanes[lane]
                    cursors[pixel] += 1
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                pixel = pixel_start(x, y, _AUXILIARY)
                medians[top + y, left + x] = state[pixel + _MEDIAN]
                first_hits[top + y, left + x] = state[pixel + _FIRST_HIT]
                largest_id[top + y, left + x] = np.int64(state[pixel + _LARGEST_ID])
                counts[top + y, left + x] = np.int64(state[pixel + _COUNT])
