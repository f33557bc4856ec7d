"""Warp kernel: what is known of a pixel besides its colour, alpha and expected depth."""

from typing import no_type_check

import warp as wp  # pyright: ignore[reportMissingImports]  # optional

from dsar.raster.warp_backend.compiling import kernel
from dsar.raster.warp_backend.kernels_compositing import (
    ALPHA_MAX_F,
    BATCH,
    LOG_ALPHA_MIN,
    PIXELS,
    T_MIN,
    THREADS,
    Floats,
    Ints,
    log_alpha_at,
    pixel_of,
    pixel_place,
    tile_corner,
)
from dsar.raster.warp_backend.kernels_projection import Record
from dsar.raster.warp_backend.tables import FIRST_INSTANCE

# For kernels that are compiled ahead of time; a launch says it itself.
wp.set_module_options({"block_dim": THREADS})


@kernel
@no_type_check
def composite_extras(
    tile_ends: wp.array[int], views: wp.array2d[int], starts: wp.array[int], pairs: wp.array[int],
    records: wp.array[Record], medians: wp.array[float], first_hits: wp.array[float],
    largest_ids: wp.array[wp.int64], counts: wp.array[wp.int64],
    cursors: wp.array[wp.int64], ids: wp.array[wp.int64], weights: wp.array[float],
):  # fmt: skip
    """Blend once more, for depths, the largest weight and how many splats each pixel has.

    If `ids` is not empty, write each pixel's Gaussians and weights from its cursor on. One kernel does both,
    because another might round otherwise, and find another number of splats.
    """
    tile, thread = wp.tid()
    view = wp.lower_bound(tile_ends, tile + 1)
    corner = tile_corner(tile, view, views)
    light, median, first_hit, largest = Floats(), Floats(), Floats(), Floats()
    largest_id, count = Ints(), Ints()
    for p in range(PIXELS):
        largest_id[p] = -1
        if pixel_place(pixel_of(corner, thread, p), view, views) >= 0:
            light[p] = 1.0
    for first in range(starts[tile], starts[tile + 1], BATCH):
        if wp.tile_max(wp.tile(wp.max(light)))[0] <= 0.0:
            break
        instances = wp.tile_load(pairs, shape=(BATCH,), offset=(first,), storage="shared")
        batch = wp.tile_load_indexed(records, instances, shape=(BATCH,), storage="shared")
        for j in range(wp.min(BATCH, starts[tile + 1] - first)):
            r = batch[j]
            gaussian = instances[j] - views[view, FIRST_INSTANCE]
            for p in range(PIXELS):
                if light[p] > 0.0:
                    pixel = pixel_of(corner, thread, p)
                    e = log_alpha_at(r, float(pixel[0]) + 0.5, float(pixel[1]) + 0.5)
                    if e[2] >= LOG_ALPHA_MIN:
                        a = wp.min(wp.exp(e[2]), ALPHA_MAX_F)
                        after = light[p] * (1.0 - a)
                        if after > T_MIN:
                            weight = a * light[p]
                            if light[p] > 0.5:
                                median[p] = r[9]
                            if count[p] == 0:
                                first_hit[p] = r[9]
                            if weight > largest[p]:
                                largest[p] = weight
                                largest_id[p] = gaussian
                            if ids.shape[0] > 0:
                                slot = int(cursors[pixel_place(pixel, view, views)]) + count[p]
                                ids[slot] = wp.int64(gaussian)
                                weights[slot] = weight
                            count[p] = count[p] + 1
                            light[p] = after
                        else:
                            light[p] = -light[p]
    for p in range(PIXELS):
        place = pixel_place(pixel_of(corner, thread, p), view, views)
        if place >= 0:
            medians[place] = median[p]
            first_hits[place] = first_hit[p]
            largest_ids[place] = wp.int64(largest_id[p])
            counts[place] = wp.int64(count[p])
