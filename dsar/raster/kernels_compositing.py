"""Numba kernels: splats blended front to back into the pixels of a tile, and the way back.

The state of a tile, block by block, is `tile_state`'s.

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

from dsar.raster.conventions import ALPHA_MAX
from dsar.raster.jit import inlined, kernel
from dsar.raster.simd import LANES, broadcast, count_trailing_zeros, load, reduce_add, select, store
from dsar.raster.tile_state import (
    CHECK_INTERVAL,
    TRANSMITTANCE,
    blend,
    find_active,
    init_tile,
    new_state,
    pixel_start,
    prefetch_record,
    splat_in_tile,
)
from dsar.raster.tiles import BLOCKS, TILE

# Planes of a block, behind those of `tile_state`.
# Forward: what has been blended so far.
_RED, _GREEN, _BLUE, _DEPTH = (np.uint64(plane * LANES) for plane in (3, 4, 5, 6))
_FORWARD = np.uint64(7 * LANES)
# Backward: the gradient that arrives at the pixel, that of depth times depth, and `rest`.
_V_RED, _V_GREEN, _V_BLUE, _V_DEPTH, _LEVEL, _REST = (
    np.uint64(plane * LANES) for plane in (3, 4, 5, 6, 7, 8)
)
_BACKWARD = np.uint64(9 * LANES)

_LOG_ALPHA_MAX = np.float32(math.log2(ALPHA_MAX))
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@inlined
def _add(state, index, values):
    store(state, index, load(state, index) + values)


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
            pixel = pixel_start(x, y, _FORWARD)
            transmittance = abs(state[pixel + TRANSMITTANCE])
            color[top + y, left + x, 0] = state[pixel + _RED] + transmittance * background[0]
            color[top + y, left + x, 1] = state[pixel + _GREEN] + transmittance * background[1]
            color[top + y, left + x, 2] = state[pixel + _BLUE] + transmittance * background[2]
            alpha[top + y, left + x] = _ONE - transmittance
            hit = transmittance < _ONE
            depth[top + y, left + x] = state[pixel + _DEPTH] / (_ONE - transmittance) if hit else _ZERO


@kernel
def composite_part(part, parts, records, tile_offsets, pairs, tiles_x, background, color, alpha, depth):
    """Blend the splats of every parts-th tile into the images."""
    height, width = alpha.shape
    state, flat = new_state(_FORWARD), records.reshape(-1)
    # Neighbouring tiles cost about the same: dealing them out in turn keeps the parts even.
    for tile in range(part, len(tile_offsets) - 1, parts):
        left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
        start, end = np.uint64(tile_offsets[tile]), np.uint64(tile_offsets[tile + 1])
        if start == end:
            _write_empty_tile(left, top, background, color, alpha, depth)
            continue
        init_tile(state, _FORWARD, width - left, height - top)
        for block in range(np.uint64(BLOCKS)):
            for plane in (_RED, _GREEN, _BLUE, _DEPTH):
                store(state, block * _FORWARD + plane, broadcast(_ZERO))
        active = find_active(state, _FORWARD)
        for index in range(start, end):
            if (index - start) % np.uint64(CHECK_INTERVAL) == np.uint64(CHECK_INTERVAL - 1):
                active = find_active(state, _FORWARD)
                if active == np.uint32(0):
                    break
            prefetch_record(flat, pairs, index)
            blocks, i = np.uint32(pairs[index, 1]) & active, np.uint64(pairs[index, 0])
            _blend_splat(state, blocks, records, i, left, top)
        _write_tile(state, left, top, background, color, alpha, depth)


@inlined
def _blend_splat(state, blocks, records, i, left, top):
    """Blend one splat over a set of blocks."""
    splat = splat_in_tile(records, i, left, top)
    red, green, blue, z = records[i, 6], records[i, 7], records[i, 8], records[i, 9]
    while blocks != np.uint32(0):
        start = count_trailing_zeros(blocks) * _FORWARD
        blocks &= blocks - np.uint32(1)
        _, _, _, weight, _ = blend(state, start, *splat)
        _add(state, start + _RED, weight * red)
        _add(state, start + _GREEN, weight * green)
        _add(state, start + _BLUE, weight * blue)
        _add(state, start + _DEPTH, weight * z)


@inlined
def _blend_splat_backward(state, blocks, records, i, left, top, out):
    """Blend one splat again, and write its gradient sums over a set of blocks."""
    splat = splat_in_tile(records, i, left, top)
    red, green, blue, z = records[i, 6], records[i, 7], records[i, 8], records[i, 9]
    zero = broadcast(_ZERO)
    s, s1, s2, s11, s12, s22 = zero, zero, zero, zero, zero, zero
    v_red, v_green, v_blue, v_z = zero, zero, zero, zero
    while blocks != np.uint32(0):
        start = count_trailing_zeros(blocks) * _BACKWARD
        blocks &= blocks - np.uint32(1)
        e1, e2, log_alpha, weight, before = blend(state, start, *splat)
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
            pixel = pixel_start(x - left, y - top, _BACKWARD)
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
    state, flat = new_state(_BACKWARD), records.reshape(-1)
    for tile in range(part, len(tile_offsets) - 1, parts):
        left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
        start, end = np.uint64(tile_offsets[tile]), np.uint64(tile_offsets[tile + 1])
        if start == end:
            continue
        init_tile(state, _BACKWARD, width - left, height - top)
        _load_gradients(state, left, top, color, alpha, depth, v_color, v_alpha, v_depth)
        active = find_active(state, _BACKWARD)
        for index in range(start, end):
            if (index - start) % np.uint64(CHECK_INTERVAL) == np.uint64(CHECK_INTERVAL - 1):
                active = find_active(state, _BACKWARD)
            prefetch_record(flat, pairs, index)
            blocks, i = np.uint32(pairs[index, 1]) & active, np.uint64(pairs[index, 0])
            if blocks == np.uint32(0):
                pair_sums[index] = _ZERO
            else:
                _blend_splat_backward(state, blocks, records, i, left, top, pair_sums[index])
