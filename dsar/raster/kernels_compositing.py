"""Numba kernels: splats blended front to back into the pixels of a tile, and the way back.

A tile's pixels live in one flat array of planes, so that the loop over a splat's rows is a single branch-free
loop over consecutive memory, which LLVM vectorises: a pixel that is finished stays in the loop, masked. Its
transmittance is kept negative, which makes every later splat fail the test `T (1 - alpha) > minimum`.

The backward pass walks front to back again and needs one running scalar per pixel: with q the splat's colour
and depth times the pixel's gradient and `rest` what all splats behind it contribute to the loss,

    dL/dalpha = q T - rest / (1 - alpha).

Work is dealt out in `parts`: a part writes only its own tiles and their slots, so results do not depend on
how many there are.
"""

import llvmlite.binding
import numpy as np

from dsar.raster.conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from dsar.raster.jit import inlined, kernel

TILE_WIDTH = 4
TILE_HEIGHT = 16
"""Four pixels wide, so that one SIMD register holds a block of rows: small splats leave fewer lanes idle."""
SUMS_SIZE = 10
"""With v = dL/d(e1² + e2²): sums of v, v e1, v e2, v e1², v e1 e2, v e2²; then dL/d(red, green, blue, z)."""

# Pixels that LLVM puts through a register at once (AVX-512: 16 floats); loops run over whole blocks of them.
_LANES = 16 if llvmlite.binding.get_host_cpu_features().get("avx512f", False) else 8
_BLOCK_ROWS = _LANES // TILE_WIDTH
# How many splats pass between two looks at whether a tile is finished.
_PATIENCE = 16
_PIXELS = TILE_WIDTH * TILE_HEIGHT
# Planes of a tile's state. Both passes: transmittance, pixel centre x and y (from the tile's corner).
_T, _X, _Y = (np.uint64(plane * _PIXELS) for plane in (0, 1, 2))
# Forward: what has been blended so far.
_RED, _GREEN, _BLUE, _DEPTH = (np.uint64(plane * _PIXELS) for plane in (3, 4, 5, 6))
# Backward: the gradient that arrives at the pixel, and `rest`.
_V_RED, _V_GREEN, _V_BLUE, _V_DEPTH, _REST = (np.uint64(plane * _PIXELS) for plane in (3, 4, 5, 6, 7))

_ALPHA_MAX, _ALPHA_MIN = np.float32(ALPHA_MAX), np.float32(ALPHA_MIN)
_T_MIN = np.float32(TRANSMITTANCE_MIN)
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
# exp(-t / 8) for t in [0, 6] (Chebyshev interpolation, 2e-8); alpha < 1/255 wherever t > 5.55.
_FALLOFF_MAX = np.float32(6.0)
_ROOT = np.polynomial.Chebyshev.interpolate(lambda t: np.exp(-t / 8), 6, domain=[0, 6])
_E0, _E1, _E2, _E3, _E4, _E5, _E6 = map(np.float32, _ROOT.convert(kind=np.polynomial.Polynomial).coef)


@inlined
def _falloff(t):
    """Return exp(-t) to 1e-6 for t in [0, 6], clamped beyond."""
    t = min(t, _FALLOFF_MAX)
    t2 = t * t
    root = (_E0 + t * _E1) + t2 * ((_E2 + t * _E3) + t2 * ((_E4 + t * _E5) + t2 * _E6))
    root *= root
    root *= root
    return root * root


@inlined
def _blend_splat(
    state, first, end, e1_origin, stretch, shear, e2_origin, height, opacity, red, green, blue, z
):
    """Blend one splat over the pixels first..end-1 of a tile; e1, e2 are 0 at its mean."""
    for pixel in range(first, end):
        e1 = e1_origin - stretch * state[pixel + _X] + shear * state[pixel + _Y]
        e2 = e2_origin - height * state[pixel + _Y]
        alpha = min(opacity * _falloff(e1 * e1 + e2 * e2), _ALPHA_MAX)
        before = state[pixel + _T]
        weight = alpha * before if alpha >= _ALPHA_MIN else _ZERO
        running = before - weight > _T_MIN
        weight = weight if running else _ZERO
        state[pixel + _T] = before - weight if running else -abs(before)
        state[pixel + _RED] += weight * red
        state[pixel + _GREEN] += weight * green
        state[pixel + _BLUE] += weight * blue
        state[pixel + _DEPTH] += weight * z


@inlined
def _blend_splat_backward(
    state, first, end, e1_origin, stretch, shear, e2_origin, height, opacity, red, green, blue, z, out
):
    """Blend one splat again, and write its gradient sums over the pixels first..end-1 of a tile."""
    s, s1, s2, s11, s12, s22 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    v_red, v_green, v_blue, v_z = _ZERO, _ZERO, _ZERO, _ZERO
    for pixel in range(first, end):
        e1 = e1_origin - stretch * state[pixel + _X] + shear * state[pixel + _Y]
        e2 = e2_origin - height * state[pixel + _Y]
        alpha = min(opacity * _falloff(e1 * e1 + e2 * e2), _ALPHA_MAX)
        before = state[pixel + _T]
        weight = alpha * before if alpha >= _ALPHA_MIN else _ZERO
        running = before - weight > _T_MIN
        weight = weight if running else _ZERO
        state[pixel + _T] = before - weight if running else -abs(before)
        q = red * state[pixel + _V_RED] + green * state[pixel + _V_GREEN]
        q += blue * state[pixel + _V_BLUE] + z * state[pixel + _V_DEPTH]
        rest = state[pixel + _REST] - weight * q
        state[pixel + _REST] = rest
        v_red += weight * state[pixel + _V_RED]
        v_green += weight * state[pixel + _V_GREEN]
        v_blue += weight * state[pixel + _V_BLUE]
        v_z += weight * state[pixel + _V_DEPTH]
        # v = -alpha dL/dalpha; where alpha is clamped it does not move with the splat's shape.
        v = weight * (rest / (before - weight) - q) if alpha < _ALPHA_MAX else _ZERO
        s += v
        s1 += v * e1
        s2 += v * e2
        s11 += v * e1 * e1
        s12 += v * e1 * e2
        s22 += v * e2 * e2
    out[0], out[1], out[2], out[3], out[4], out[5] = s, s1, s2, s11, s12, s22
    out[6], out[7], out[8], out[9] = v_red, v_green, v_blue, v_z


@inlined
def _is_finished(state):
    """Return whether every pixel of a tile has stopped."""
    left = _ZERO
    for pixel in range(_PIXELS):
        left += state[pixel] if state[pixel] > _ZERO else _ZERO
    return left == _ZERO


@inlined
def _new_state(planes):
    """Return a tile's state with its pixel centres filled in."""
    state = np.zeros(planes * _PIXELS, np.float32)
    for pixel in range(_PIXELS):
        state[_X + np.uint64(pixel)] = np.float32(pixel % TILE_WIDTH) + _HALF
        state[_Y + np.uint64(pixel)] = np.float32(pixel // TILE_WIDTH) + _HALF
    return state


@inlined
def _open_tile(state, left, top, width, height):
    """Start every pixel inside the image as transparent, every other as finished."""
    for pixel in range(_PIXELS):
        inside = left + pixel % TILE_WIDTH < width and top + pixel // TILE_WIDTH < height
        state[pixel] = _ONE if inside else -_ONE


@inlined
def _place(splat, left, top):
    """Return a splat's pixel range in a tile, in whole blocks, and its e1, e2 at the tile's corner."""
    first = max(np.int64(splat[10]) - top, 0) // _BLOCK_ROWS * _LANES
    end = (min(np.int64(splat[11]) - top, TILE_HEIGHT) + _BLOCK_ROWS - 1) // _BLOCK_ROWS * _LANES
    x, y = splat[0] - np.float32(left), splat[1] - np.float32(top)
    return np.uint64(first), np.uint64(end), splat[2] * x - splat[3] * y, splat[4] * y


@inlined
def _close_tile(state, left, top, background, color, alpha, depth):
    """Write a finished tile to the images."""
    height, width = alpha.shape
    for y in range(top, min(top + TILE_HEIGHT, height)):
        for x in range(left, min(left + TILE_WIDTH, width)):
            pixel = np.uint64((y - top) * TILE_WIDTH + x - left)
            through = abs(state[pixel + _T])
            color[y, x, 0] = state[pixel + _RED] + through * background[0]
            color[y, x, 1] = state[pixel + _GREEN] + through * background[1]
            color[y, x, 2] = state[pixel + _BLUE] + through * background[2]
            alpha[y, x] = _ONE - through
            depth[y, x] = state[pixel + _DEPTH] / (_ONE - through) if through < _ONE else _ZERO


@kernel
def composite_part(part, parts, records, tile_starts, entries, tiles_x, background, color, alpha, depth):
    """Blend the splats of every parts-th tile into the images."""
    height, width = alpha.shape
    state = _new_state(7)
    # Neighbouring tiles cost about the same: dealing them out in turn keeps the parts even.
    for tile in range(part, len(tile_starts) - 1, parts):
        left, top = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
        _open_tile(state, left, top, width, height)
        state[3 * _PIXELS :] = _ZERO
        for start in range(tile_starts[tile], tile_starts[tile + 1], _PATIENCE):
            end = min(start + _PATIENCE, tile_starts[tile + 1])
            for j in range(end - start):
                splat = records[entries[start + j]]
                first, stop, e1, e2 = _place(splat, left, top)
                _blend_splat(state, first, stop, e1, splat[2], splat[3], e2, splat[4], splat[5],
                             splat[6], splat[7], splat[8], splat[9])  # fmt: skip
            if _is_finished(state):
                break
        _close_tile(state, left, top, background, color, alpha, depth)


@inlined
def _open_tile_backward(state, left, top, color, alpha, depth, v_color, v_alpha, v_depth):
    """Load the gradients that arrive at a tile, and `rest` before the first splat. Empty arrays mean zero."""
    height, width = alpha.shape
    state[3 * _PIXELS :] = _ZERO
    for y in range(top, min(top + TILE_HEIGHT, height)):
        for x in range(left, min(left + TILE_WIDTH, width)):
            pixel = np.uint64((y - top) * TILE_WIDTH + x - left)
            rest, v_through = _ZERO, _ZERO
            if len(v_alpha) > 0:
                v_through -= v_alpha[y, x]
            if len(v_depth) > 0 and alpha[y, x] > _ZERO:
                # depth = sum(weight z) / alpha
                state[pixel + _V_DEPTH] = v_depth[y, x] / alpha[y, x]
                v_through += state[pixel + _V_DEPTH] * depth[y, x]
                rest += v_depth[y, x] * depth[y, x]
            if len(v_color) > 0:
                state[pixel + _V_RED] = v_color[y, x, 0]
                state[pixel + _V_GREEN] = v_color[y, x, 1]
                state[pixel + _V_BLUE] = v_color[y, x, 2]
                # The colour holds the background already, so its share of `rest` is included.
                for channel in range(3):
                    rest += v_color[y, x, channel] * color[y, x, channel]
            state[pixel + _REST] = rest + (_ONE - alpha[y, x]) * v_through


@kernel
def composite_backward_part(
    part, parts, records, tile_starts, entries, slots, tiles_x,
    color, alpha, depth, v_color, v_alpha, v_depth, slot_sums,
):  # fmt: skip
    """Fill the slots of every parts-th tile with the gradient sums of its splats. Empty v_* mean zero."""
    height, width = alpha.shape
    state = _new_state(8)
    for tile in range(part, len(tile_starts) - 1, parts):
        left, top = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
        _open_tile(state, left, top, width, height)
        _open_tile_backward(state, left, top, color, alpha, depth, v_color, v_alpha, v_depth)
        finished = False
        for start in range(tile_starts[tile], tile_starts[tile + 1], _PATIENCE):
            end = min(start + _PATIENCE, tile_starts[tile + 1])
            if finished:
                for j in range(start, end):
                    slot_sums[slots[j]] = _ZERO
                continue
            for j in range(end - start):
                splat = records[entries[start + j]]
                first, stop, e1, e2 = _place(splat, left, top)
                _blend_splat_backward(state, first, stop, e1, splat[2], splat[3], e2, splat[4], splat[5],
                                      splat[6], splat[7], splat[8], splat[9],
                                      slot_sums[slots[start + j]])  # fmt: skip
            finished = _is_finished(state)
