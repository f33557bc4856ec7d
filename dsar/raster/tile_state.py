"""The state of a tile while splats are blended over it, for all passes; and the blending itself.

A tile's pixels live in one flat array, block by block, each block as planes of LANES values: a splat visits
the blocks that it touches, and every step of the blending is one instruction for a whole block. A pixel that
is finished stays among its block's lanes: its transmittance is kept negative, which makes every later splat
fail the test `T (1 - alpha) > minimum`. Every few splats, blocks without a live pixel leave the tile's set.
"""

import math

import numpy as np

from dsar.raster.conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from dsar.raster.jit import inlined
from dsar.raster.simd import (
    LANES,
    broadcast,
    exp2,
    load,
    minimum,
    movemask,
    negative_abs,
    prefetch,
    select,
    store,
)
from dsar.raster.tiles import BLOCK_HEIGHT, BLOCK_WIDTH, BLOCKS, PREFETCH_DISTANCE, RECORD_SIZE, STRIPS

# How many splats pass between two looks at which blocks are finished.
CHECK_INTERVAL = 32
# Planes of a block in every pass: transmittance, pixel centre x and y (from the tile's corner).
TRANSMITTANCE, CENTER_X, CENTER_Y = (np.uint64(plane * LANES) for plane in (0, 1, 2))

_LOG_ALPHA_MIN, _ALPHA_MAX = np.float32(math.log2(ALPHA_MIN)), np.float32(ALPHA_MAX)
_T_MIN = np.float32(TRANSMITTANCE_MIN)
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@inlined
def new_state(stride):
    """Return a tile's state, blocks of `stride` values, with its pixel centres filled in."""
    state = np.zeros(BLOCKS * stride, np.float32)
    for block in range(BLOCKS):
        for lane in range(LANES):
            pixel = block * stride + np.uint64(lane)
            x, y = block // STRIPS * BLOCK_WIDTH, block % STRIPS * BLOCK_HEIGHT
            state[pixel + CENTER_X] = np.float32(x + lane % BLOCK_WIDTH) + _HALF
            state[pixel + CENTER_Y] = np.float32(y + lane // BLOCK_WIDTH) + _HALF
    return state


@inlined
def pixel_start(x, y, stride):
    """Return where a pixel of the tile lies in its state."""
    block = x // BLOCK_WIDTH * STRIPS + y // BLOCK_HEIGHT
    return np.uint64(block) * stride + np.uint64(y % BLOCK_HEIGHT * BLOCK_WIDTH + x % BLOCK_WIDTH)


@inlined
def init_tile(state, stride, width, height):
    """Start pixels inside the image, which ends at `width`, `height`, as transparent, others as finished."""
    width, height = np.float32(width), np.float32(height)
    for block in range(np.uint64(BLOCKS)):
        start = block * stride
        inside = (load(state, start + CENTER_X) < width) & (load(state, start + CENTER_Y) < height)
        store(state, start, select(inside, broadcast(_ONE), broadcast(-_ONE)))


@inlined
def find_active(state, stride):
    """Return the set of blocks with a pixel that is not finished."""
    active = np.uint32(0)
    for block in range(np.uint64(BLOCKS)):
        if movemask(load(state, block * stride) > _ZERO) != np.uint32(0):
            active |= np.uint32(1) << np.uint32(block)
    return active


@inlined
def prefetch_record(records, pairs, index):
    """Have the record of a splat that is due soon brought into the cache."""
    ahead = index + np.uint64(PREFETCH_DISTANCE)
    if ahead < np.uint64(len(pairs)):
        prefetch(records, np.uint64(pairs[ahead, 0]) * np.uint64(RECORD_SIZE))


@inlined
def splat_in_tile(records, i, left, top):
    """Return what `blend` needs of a splat, with the tile's corner as origin."""
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
def blend(state, start, e1_origin, stretch, shear, e2_origin, height, log_opacity):
    """Pass one splat over one block; return e1, e2, log2 alpha, weight and the transmittance before it."""
    e1 = e1_origin - stretch * load(state, start + CENTER_X) + shear * load(state, start + CENTER_Y)
    e2 = e2_origin - height * load(state, start + CENTER_Y)
    log_alpha = log_opacity - e1 * e1 - e2 * e2
    alpha = minimum(exp2(log_alpha), broadcast(_ALPHA_MAX))
    before = load(state, start + TRANSMITTANCE)
    weight = select(log_alpha >= _LOG_ALPHA_MIN, alpha * before, broadcast(_ZERO))
    after = before - weight
    running = after > _T_MIN
    store(state, start + TRANSMITTANCE, select(running, after, negative_abs(before)))
    return e1, e2, log_alpha, select(running, weight, broadcast(_ZERO)), before
