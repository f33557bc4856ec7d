"""Numba kernels: splats blended front to back into the pixels of a tile, and the way back.

A tile's pixels live in one flat array, block by block, each block as planes of LANES values: a splat visits
the blocks that it touches, and every step of the blending is one instruction for a whole block. A pixel that
is finished stays among its block's lanes: its transmittance is kept negative, which makes every later splat
fail the test `T (1 - alpha) > minimum`. Every few splats, blocks without a live pixel leave the tile's set.

The backward pass walks front to back again and needs one running scalar per pixel: with q the splat's colour,
and how far it is behind the pixel's depth, times the pixel's gradient, and `rest` what all splats behind it
contribute to the loss,

    dL/dalpha = q T - rest / (1 - alpha).

It leaves SUMS_SIZE sums over the pixels of every pair: with v = dL/d(e1² + e2²) those of v, v e1, v e2,
v e1², v e1 e2, v e2², then of dL/d(red, green, blue, z).

Work is dealt out in `parts`: a part writes only its own tiles and their pairs, so results do not depend on
how many there are.
"""

import math

import numpy as np

from dsar.raster.conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from dsar.raster.jit import inlined, kernel
from dsar.raster.simd import (
    LANES,
    broadcast,
    count_trailing_zeros,
    exp2,
    load,
    minimum,
    movemask,
    negative_abs,
    prefetch,
    reduce_add,
    select,
    store,
)
from dsar.raster.tiles import BLOCK_HEIGHT, BLOCK_WIDTH, BLOCKS, PREFETCH_DISTANCE, RECORD_SIZE, STRIPS, TILE

# How many splats pass between two looks at which blocks are finished.
_CHECK_INTERVAL = 32
# Planes of a block. Both passes: transmittance, pixel centre x and y (from the tile's corner).
_T, _X, _Y = (np.uint64(plane * LANES) for plane in (0, 1, 2))
# Forward: what has been blended so far.
_RED, _GREEN, _BLUE, _DEPTH = (np.uint64(plane * LANES) for plane in (3, 4, 5, 6))
_FORWARD = np.uint64(7 * LANES)
# Backward: the gradient that arrives at the pixel, that of depth times depth, and `rest`.
_V_RED, _V_GREEN, _V_BLUE, _V_DEPTH, _LEVEL, _REST = (
    np.uint64(plane * LANES) for plane in (3, 4, 5, 6, 7, 8)
)
_BACKWARD = np.uint64(9 * LANES)
# Auxiliary pass: depth at half transmittance, how many splats were blended, depth of the first, and the
# largest weight with its splat (a number that is exact up to 16 million).
_MEDIAN, _COUNT, _FIRST_HIT, _LARGEST_WEIGHT, _LARGEST_ID = (
    np.uint64(plane * LANES) for plane in (3, 4, 5, 6, 7)
)
_AUXILIARY = np.uint64(8 * LANES)

_LOG_ALPHA_MIN, _LOG_ALPHA_MAX = np.float32(math.log2(ALPHA_MIN)), np.float32(math.log2(ALPHA_MAX))
_ALPHA_MAX, _T_MIN = np.float32(ALPHA_MAX), np.float32(TRANSMITTANCE_MIN)
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@inlined
def _new_state(stride):
    """Return a tile's state, blocks of `stride` values, with its pixel centres filled in."""
    state = np.zeros(BLOCKS * stride, np.float32)
    for block in range(BLOCKS):
        for lane in range(LANES):
            pixel = block * stride + np.uint64(lane)
            x, y = block // STRIPS * BLOCK_WIDTH, block % STRIPS * BLOCK_HEIGHT
            state[pixel + _X] = np.float32(x + lane % BLOCK_WIDTH) + _HALF
            state[pixel + _Y] = np.float32(y + lane // BLOCK_WIDTH) + _HALF
    return state


@inlined
def _pixel(x, y, stride):
    """Return where a pixel of the tile lies in its state."""
    block = x // BLOCK_WIDTH * STRIPS + y // BLOCK_HEIGHT
    return np.uint64(block) * stride + np.uint64(y % BLOCK_HEIGHT * BLOCK_WIDTH + x % BLOCK_WIDTH)


@inlined
def _init_tile(state, stride, width, height):
    """Start pixels inside the image, which ends at `width`, `height`, as transparent, others as finished."""
    width, height = np.float32(width), np.float32(height)
    for block in range(np.uint64(BLOCKS)):
        start = block * stride
        inside = (load(state, start + _X) < width) & (load(state, start + _Y) < height)
        store(state, start, select(inside, broadcast(_ONE), broadcast(-_ONE)))


@inlined
def _find_active(state, stride):
    """Return the set of blocks with a pixel that is not finished."""
    active = np.uint32(0)
    for block in range(np.uint64(BLOCKS)):
        if movemask(load(state, block * stride) > _ZERO) != np.uint32(0):
            active |= np.uint32(1) << np.uint32(block)
    return active


@inlined
def _prefetch_record(records, pairs, place):
    """Have the record of a splat that is due soon brought into the cache."""
    due = place + np.uint64(PREFETCH_DISTANCE)
    if due < np.uint64(len(pairs)):
        prefetch(records, np.uint64(pairs[due, 0]) * np.uint64(RECORD_SIZE))


@inlined
def _splat_in_tile(records, i, left, top):
    """Return what `_blend` needs of a splat, with the tile's corner as origin."""
    x, y = records[i, 0] - np.float32(left), records[i, 1] - np.float32(top)
    return (
        broadcast(records[i, 2] * x - records[i, 3] * y),
        broadcast(records[i, 2]),
        broadcast(records[i, 3]),
        broadcast(records[i, 4] * y),
        broadcast(records[i, 4]),
        broadcast(records[i, 5]),
    )


@inlined
def _blend(state, start, e1_origin, stretch, shear, e2_origin, height, log_opacity):
    """Pass one splat over one block; return e1, e2, log2 alpha, weight and the transmittance before it."""
    e1 = e1_origin - stretch * load(state, start + _X) + shear * load(state, start + _Y)
    e2 = e2_origin - height * load(state, start + _Y)
    log_alpha = log_opacity - e1 * e1 - e2 * e2
    alpha = minimum(exp2(log_alpha), broadcast(_ALPHA_MAX))
    before = load(state, start + _T)
    weight = select(log_alpha >= _LOG_ALPHA_MIN, alpha * before, broadcast(_ZERO))
    after = before - weight
    running = after > _T_MIN
    store(state, start + _T, select(running, after, negative_abs(before)))
    return e1, e2, log_alpha, select(running, weight, broadcast(_ZERO)), before


@inlined
def _add(state, place, values):
    store(state, place, load(state, place) + values)


@inlined
def _write_empty_tile(left, top, background, color, alpha, depth):
    """Write a tile that no splat touches to the images."""
    height, width = alpha.shape
    for y in range(top, min(top + TILE, height)):
        for x in range(left, min(left + TILE, width)):
            color[y, x, 0], color[y, x, 1], color[y, x, 2] = background[0], background[1], background[2]
            alpha[y, x] = depth[y, x] = _ZERO


@inlined
def _write_tile(state, left, top, background, color, alpha, depth):
    """Write a finished tile to the images."""
    height, width = alpha.shape
    for y in range(min(TILE, height - top)):
        for x in range(min(TILE, width - left)):
            pixel = _pixel(x, y, _FORWARD)
            through = abs(state[pixel + _T])
            color[top + y, left + x, 0] = state[pixel + _RED] + through * background[0]
            color[top + y, left + x, 1] = state[pixel + _GREEN] + through * background[1]
            color[top + y, left + x, 2] = state[pixel + _BLUE] + through * background[2]
            alpha[top + y, left + x] = _ONE - through
            hit = through < _ONE
            depth[top + y, left + x] = state[pixel + _DEPTH] / (_ONE - through) if hit else _ZERO


@kernel
def composite_part(part, parts, records, tile_offsets, pairs, tiles_x, background, color, alpha, depth):
    """Blend the splats of every parts-th tile into the images."""
    height, width = alpha.shape
    state, flat = _new_state(_FORWARD), records.reshape(-1)
    # Neighbouring tiles cost about the same: dealing them out in turn keeps the parts even.
    for tile in range(part, len(tile_offsets) - 1, parts):
        left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
        start, end = np.uint64(tile_offsets[tile]), np.uint64(tile_offsets[tile + 1])
        if start == end:
            _write_empty_tile(left, top, background, color, alpha, depth)
            continue
        _init_tile(state, _FORWARD, width - left, height - top)
        for block in range(np.uint64(BLOCKS)):
            for plane in (_RED, _GREEN, _BLUE, _DEPTH):
                store(state, block * _FORWARD + plane, broadcast(_ZERO))
        active = _find_active(state, _FORWARD)
        for place in range(start, end):
            if (place - start) % np.uint64(_CHECK_INTERVAL) == np.uint64(_CHECK_INTERVAL - 1):
                active = _find_active(state, _FORWARD)
                if active == np.uint32(0):
                    break
            _prefetch_record(flat, pairs, place)
            blocks, i = np.uint32(pairs[place, 1]) & active, np.uint64(pairs[place, 0])
            _blend_splat(state, blocks, records, i, left, top)
        _write_tile(state, left, top, background, color, alpha, depth)


@inlined
def _blend_splat(state, blocks, records, i, left, top):
    """Blend one splat over a set of blocks."""
    splat = _splat_in_tile(records, i, left, top)
    red, green, blue, z = records[i, 6], records[i, 7], records[i, 8], records[i, 9]
    while blocks != np.uint32(0):
        start = count_trailing_zeros(blocks) * _FORWARD
        blocks &= blocks - np.uint32(1)
        _, _, _, weight, _ = _blend(state, start, *splat)
        _add(state, start + _RED, weight * red)
        _add(state, start + _GREEN, weight * green)
        _add(state, start + _BLUE, weight * blue)
        _add(state, start + _DEPTH, weight * z)


@inlined
def _blend_splat_backward(state, blocks, records, i, left, top, out):
    """Blend one splat again, and write its gradient sums over a set of blocks."""
    splat = _splat_in_tile(records, i, left, top)
    red, green, blue, z = records[i, 6], records[i, 7], records[i, 8], records[i, 9]
    zero = broadcast(_ZERO)
    s, s1, s2, s11, s12, s22 = zero, zero, zero, zero, zero, zero
    v_red, v_green, v_blue, v_z = zero, zero, zero, zero
    while blocks != np.uint32(0):
        start = count_trailing_zeros(blocks) * _BACKWARD
        blocks &= blocks - np.uint32(1)
        e1, e2, log_alpha, weight, before = _blend(state, start, *splat)
        q = red * load(state, start + _V_RED) + green * load(state, start + _V_GREEN)
        q += blue * load(state, start + _V_BLUE)
        q += z * load(state, start + _V_DEPTH) - load(state, start + _LEVEL)
        rest = load(state, start + _REST) - weight * q
        store(state, start + _REST, rest)
        v_red += weight * load(state, start + _V_RED)
        v_green += weight * load(state, start + _V_GREEN)
        v_blue += weight * load(state, start + _V_BLUE)
        v_z += weight * load(state, start + _V_DEPTH)
        # v = -alpha dL/dalpha; where alpha is clamped it does not move with the splat's shape.
        v = select(log_alpha < _LOG_ALPHA_MAX, weight * (rest / (before - weight) - q), zero)
        v1, v2 = v * e1, v * e2
        s += v
        s1 += v1
        s2 += v2
        s11 += v1 * e1
        s12 += v1 * e2
        s22 += v2 * e2
    out[0], out[1], out[2], out[3], out[4], out[5] = (
        reduce_add(s), reduce_add(s1), reduce_add(s2), reduce_add(s11), reduce_add(s12), reduce_add(s22)
    )  # fmt: skip
    out[6], out[7], out[8], out[9] = (
        reduce_add(v_red),
        reduce_add(v_green),
        reduce_add(v_blue),
        reduce_add(v_z),
    )


@inlined
def _load_gradients(state, left, top, color, alpha, depth, v_color, v_alpha, v_depth):
    """Load the gradients that arrive at a tile, and `rest` before the first splat. Empty arrays mean zero."""
    height, width = alpha.shape
    if left + TILE > width or top + TILE > height:
        # Else pixels outside would keep the gradients of another tile.
        for block in range(np.uint64(BLOCKS)):
            for plane in (_V_RED, _V_GREEN, _V_BLUE, _V_DEPTH, _LEVEL, _REST):
                store(state, block * _BACKWARD + plane, broadcast(_ZERO))
    for y in range(top, min(top + TILE, height)):
        for x in range(left, min(left + TILE, width)):
            pixel = _pixel(x - left, y - top, _BACKWARD)
            red, green, blue, v_z, rest = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
            if len(v_alpha) > 0:
                rest -= (_ONE - alpha[y, x]) * v_alpha[y, x]
            if len(v_depth) > 0 and alpha[y, x] > _ZERO:
                # depth = sum(weight z) / sum(weight)
                v_z = v_depth[y, x] / alpha[y, x]
            if len(v_color) > 0:
                red, green, blue = v_color[y, x, 0], v_color[y, x, 1], v_color[y, x, 2]
                # The colour holds the background already, so its share of `rest` is included.
                rest += red * color[y, x, 0] + green * color[y, x, 1] + blue * color[y, x, 2]
            state[pixel + _V_RED], state[pixel + _V_GREEN], state[pixel + _V_BLUE] = red, green, blue
            state[pixel + _V_DEPTH], state[pixel + _LEVEL] = v_z, v_z * depth[y, x]
            state[pixel + _REST] = rest


@kernel
def composite_backward_part(
    part, parts, records, tile_offsets, pairs, tiles_x,
    color, alpha, depth, v_color, v_alpha, v_depth, pair_sums,
):  # fmt: skip
    """Write the gradient sums of every pair in every parts-th tile. Empty v_* mean zero."""
    height, width = alpha.shape
    state, flat = _new_state(_BACKWARD), records.reshape(-1)
    for tile in range(part, len(tile_offsets) - 1, parts):
        left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
        start, end = np.uint64(tile_offsets[tile]), np.uint64(tile_offsets[tile + 1])
        if start == end:
            continue
        _init_tile(state, _BACKWARD, width - left, height - top)
        _load_gradients(state, left, top, color, alpha, depth, v_color, v_alpha, v_depth)
        active = _find_active(state, _BACKWARD)
        for place in range(start, end):
            if (place - start) % np.uint64(_CHECK_INTERVAL) == np.uint64(_CHECK_INTERVAL - 1):
                active = _find_active(state, _BACKWARD)
            _prefetch_record(flat, pairs, place)
            blocks, i = np.uint32(pairs[place, 1]) & active, np.uint64(pairs[place, 0])
            if blocks == np.uint32(0):
                pair_sums[place] = _ZERO
            else:
                _blend_splat_backward(state, blocks, records, i, left, top, pair_sums[place])


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
    state, flat = _new_state(_AUXILIARY), records.reshape(-1)
    lanes, cursors = np.empty(LANES, np.float32), np.zeros(BLOCKS * LANES, np.int64)
    collecting = len(ids) > 0
    for tile in range(part, len(tile_offsets) - 1, parts):
        left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
        _init_tile(state, _AUXILIARY, width - left, height - top)
        for block in range(np.uint64(BLOCKS)):
            for plane in (_MEDIAN, _COUNT, _FIRST_HIT, _LARGEST_WEIGHT):
                store(state, block * _AUXILIARY + plane, broadcast(_ZERO))
            store(state, block * _AUXILIARY + _LARGEST_ID, broadcast(-_ONE))
        if collecting:
            for y in range(min(TILE, height - top)):
                for x in range(min(TILE, width - left)):
                    cursors[_pixel(x, y, np.uint64(LANES))] = starts[(top + y) * width + left + x]
        active = _find_active(state, _AUXILIARY)
        first, end = np.uint64(tile_offsets[tile]), np.uint64(tile_offsets[tile + 1])
        for place in range(first, end):
            if (place - first) % np.uint64(_CHECK_INTERVAL) == np.uint64(_CHECK_INTERVAL - 1):
                active = _find_active(state, _AUXILIARY)
                if active == np.uint32(0):
                    break
            _prefetch_record(flat, pairs, place)
            blocks, i = np.uint32(pairs[place, 1]) & active, np.uint64(pairs[place, 0])
            splat = _splat_in_tile(records, i, left, top)
            while blocks != np.uint32(0):
                block = count_trailing_zeros(blocks)
                start = block * _AUXILIARY
                blocks &= blocks - np.uint32(1)
                _, _, _, weight, before = _blend(state, start, *splat)
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
                pixel = _pixel(x, y, _AUXILIARY)
                medians[top + y, left + x] = state[pixel + _MEDIAN]
                first_hits[top + y, left + x] = state[pixel + _FIRST_HIT]
                largest_id[top + y, left + x] = np.int64(state[pixel + _LARGEST_ID])
                counts[top + y, left + x] = np.int64(state[pixel + _COUNT])
