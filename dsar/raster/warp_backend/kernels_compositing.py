"""Warp kernels: splats blended front to back into the pixels of a tile, and the way back.

A block of THREADS threads takes a tile, each thread PIXELS of its pixels. Splats come into the block's shared
memory BATCH at a time. On the way back every thread adds up a splat's gradient over its pixels, the block
adds up its threads', and one record leaves for each pair of a splat and a tile: no two blocks write to one
place, so gradients are the same to the bit in every run.
"""

import math
from typing import no_type_check

import warp as wp  # pyright: ignore[reportMissingImports]  # optional

from dsar.raster.conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from dsar.raster.warp_backend.compiling import func, kernel
from dsar.raster.warp_backend.kernels_projection import Record
from dsar.raster.warp_backend.tables import FIRST_PIXEL, FIRST_TILE, HEIGHT, TILE, TILES_X, WIDTH

THREADS = wp.constant(64)
PIXELS = wp.constant(TILE * TILE // THREADS)
BATCH = wp.constant(64)
# For kernels that are compiled ahead of time; a launch says it itself.
wp.set_module_options({"block_dim": THREADS})

Floats = wp.types.vector(length=PIXELS, dtype=wp.float32)
Ints = wp.types.vector(length=PIXELS, dtype=wp.int32)

LOG_ALPHA_MIN, ALPHA_MAX_F = wp.constant(math.log(ALPHA_MIN)), wp.constant(ALPHA_MAX)
T_MIN = wp.constant(TRANSMITTANCE_MIN)
_LOG_ALPHA_MAX = wp.constant(math.log(ALPHA_MAX))


@func
@no_type_check
def tile_corner(tile: int, view: int, views: wp.array2d[int]):
    """Return the left and top pixel of a tile."""
    local = tile - views[view, FIRST_TILE]
    across = views[view, TILES_X]
    return wp.vec2i(local % across * TILE, local // across * TILE)


@func
@no_type_check
def pixel_of(corner: wp.vec2i, thread: int, p: int):
    """Return the p-th pixel of a thread: neighbours belong to neighbouring threads."""
    q = thread + p * THREADS
    return wp.vec2i(corner[0] + q % TILE, corner[1] + q // TILE)


@func
@no_type_check
def pixel_place(pixel: wp.vec2i, view: int, views: wp.array2d[int]):
    """Return where a pixel lies in flat images, -1 outside its view."""
    if pixel[0] >= views[view, WIDTH] or pixel[1] >= views[view, HEIGHT]:
        return -1
    return views[view, FIRST_PIXEL] + pixel[1] * views[view, WIDTH] + pixel[0]


@func
@no_type_check
def log_alpha_at(r: Record, x: float, y: float):
    """Return e1, e2 and the logarithm of a splat's alpha (not yet limited) at a point of the image."""
    dx, dy = r[0] - x, r[1] - y
    e1 = r[2] * dx - r[3] * dy
    e2 = r[4] * dy
    return wp.vec3(e1, e2, r[5] - e1 * e1 - e2 * e2)


@kernel
@no_type_check
def composite(
    tile_ends: wp.array[int], views: wp.array2d[int], starts: wp.array[int], pairs: wp.array[int],
    records: wp.array[Record], backgrounds: wp.array[wp.vec3],
    color: wp.array[wp.vec3], alpha: wp.array[float], depth: wp.array[float],
    passed: wp.array[float], lasts: wp.array[int],
):  # fmt: skip
    """Blend the splats of every tile into the images.

    Keeps each pixel's transmittance and the end of what it blended in its tile's list, for the way back.
    """
    tile, thread = wp.tid()
    view = wp.lower_bound(tile_ends, tile + 1)
    corner = tile_corner(tile, view, views)
    red, green, blue, far = Floats(), Floats(), Floats(), Floats()
    last = Ints()
    # Kept negative once a pixel is finished; 0 outside the image.
    light = Floats()
    for p in range(PIXELS):
        last[p] = starts[tile]
        if pixel_place(pixel_of(corner, thread, p), view, views) >= 0:
            light[p] = 1.0
    for first in range(starts[tile], starts[tile + 1], BATCH):
        if wp.tile_max(wp.tile(wp.max(light)))[0] <= 0.0:
            break
        ids = wp.tile_load(pairs, shape=(BATCH,), offset=(first,), storage="shared")
        batch = wp.tile_load_indexed(records, ids, shape=(BATCH,), storage="shared")
        for j in range(wp.min(BATCH, starts[tile + 1] - first)):
            r = batch[j]
            for p in range(PIXELS):
                if light[p] > 0.0:
                    pixel = pixel_of(corner, thread, p)
                    e = log_alpha_at(r, float(pixel[0]) + 0.5, float(pixel[1]) + 0.5)
                    if e[2] >= LOG_ALPHA_MIN:
                        a = wp.min(wp.exp(e[2]), ALPHA_MAX_F)
                        after = light[p] * (1.0 - a)
                        if after > T_MIN:
                            weight = a * light[p]
                            red[p] = red[p] + weight * r[6]
                            green[p] = green[p] + weight * r[7]
                            blue[p] = blue[p] + weight * r[8]
                            far[p] = far[p] + weight * r[9]
                            light[p] = after
                            last[p] = first + j + 1
                        else:
                            light[p] = -light[p]
    for p in range(PIXELS):
        place = pixel_place(pixel_of(corner, thread, p), view, views)
        if place >= 0:
            left = wp.abs(light[p])
            color[place] = wp.vec3(red[p], green[p], blue[p]) + backgrounds[view] * left
            alpha[place] = 1.0 - left
            depth[place] = wp.where(left < 1.0, far[p] / (1.0 - left), 0.0)
            passed[place] = left
            lasts[place] = last[p]


@kernel
@no_type_check
def composite_backward(
    tile_ends: wp.array[int], views: wp.array2d[int], starts: wp.array[int], pairs: wp.array[int],
    records: wp.array[Record], backgrounds: wp.array[wp.vec3], depth: wp.array[float],
    passed: wp.array[float], lasts: wp.array[int],
    v_color: wp.array[wp.vec3], v_alpha: wp.array[float], v_depth: wp.array[float],
    places: wp.array[wp.int64], pair_sums: wp.array[Record],
):  # fmt: skip
    """Write the gradient of every pair's record, summed over the tile, to the pair's place before sorting.

    With q what a splat's colour and depth are worth to a pixel, T the transmittance before it, and `behind`
    what all splats behind it contribute to the loss, dL/dalpha = q T - behind / (1 - alpha).
    """
    tile, thread = wp.tid()
    view = wp.lower_bound(tile_ends, tile + 1)
    corner = tile_corner(tile, view, views)
    light, behind, last = Floats(), Floats(), Ints()
    v_red, v_green, v_blue, v_far, level = Floats(), Floats(), Floats(), Floats(), Floats()
    for p in range(PIXELS):
        place = pixel_place(pixel_of(corner, thread, p), view, views)
        last[p] = starts[tile]
        if place >= 0:
            light[p] = passed[place]
            last[p] = lasts[place]
            v = v_color[place]
            v_red[p] = v[0]
            v_green[p] = v[1]
            v_blue[p] = v[2]
            if light[p] < 1.0:
                v_far[p] = v_depth[place] / (1.0 - light[p])
            level[p] = v_alpha[place] - wp.dot(v, backgrounds[view]) - v_far[p] * depth[place]
    newest = wp.tile_max(wp.tile(wp.max(last)))[0]
    for skipped in range(0, newest - starts[tile], BATCH):
        end = newest - skipped
        first = wp.max(starts[tile], end - BATCH)
        ids = wp.tile_load(pairs, shape=(BATCH,), offset=(first,), storage="shared")
        batch = wp.tile_load_indexed(records, ids, shape=(BATCH,), storage="shared")
        for back in range(end - first):
            k = end - 1 - back
            r = batch[k - first]
            sums = Record()
            for p in range(PIXELS):
                if k < last[p]:
                    pixel = pixel_of(corner, thread, p)
                    x, y = float(pixel[0]) + 0.5, float(pixel[1]) + 0.5
                    e = log_alpha_at(r, x, y)
                    if e[2] >= LOG_ALPHA_MIN:
                        a = wp.min(wp.exp(e[2]), ALPHA_MAX_F)
                        before = light[p] / (1.0 - a)
                        weight = a * before
                        q = (
                            v_red[p] * r[6]
                            + v_green[p] * r[7]
                            + v_blue[p] * r[8]
                            + v_far[p] * r[9]
                            + level[p]
                        )
                        v_log = float(0.0)
                        if e[2] < _LOG_ALPHA_MAX:
                            v_log = a * (q * before - behind[p] / (1.0 - a))
                        behind[p] = behind[p] + weight * q
                        light[p] = before
                        v_e1, v_e2 = -2.0 * e[0] * v_log, -2.0 * e[1] * v_log
                        dx, dy = r[0] - x, r[1] - y
                        sums = sums + Record(
                            v_e1 * r[2], v_e2 * r[4] - v_e1 * r[3], v_e1 * dx, -v_e1 * dy, v_e2 * dy, v_log,
                            weight * v_red[p], weight * v_green[p], weight * v_blue[p], weight * v_far[p],
                        )  # fmt: skip
            total = wp.tile_sum(wp.tile(sums, preserve_type=True))
            wp.tile_store(pair_sums, total, offset=(int(places[k]),))
