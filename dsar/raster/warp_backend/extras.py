"""The outputs besides colour, alpha and expected depth."""

from collections.abc import Collection
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from dsar.raster.warp_backend.compiling import launch
from dsar.raster.warp_backend.kernels_compositing import THREADS
from dsar.raster.warp_backend.kernels_extras import composite_extras
from dsar.raster.warp_backend.splats import Splats
from dsar.raster.warp_backend.tables import Tables
from dsar.types import Contributors


def draw_extras(splats: Splats, outputs: Collection[str]) -> list[dict[str, Any]]:
    """Return each view's requested outputs by name."""
    tables, records = splats.tables, splats.records
    views: list[dict[str, Any]] = [{} for _ in tables.sizes]
    if not outputs:
        return views
    size = sum(tables.pixels)
    medians, first_hits = records.new_empty(size), records.new_empty(size)
    largest_ids, counts = (torch.empty(size, dtype=torch.int64, device=records.device) for _ in range(2))

    def draw(cursors: Int64[Tensor, " *p"], ids: Int64[Tensor, " m"], weights: Float[Tensor, " m"]) -> None:
        arguments = [*splats.lists, medians, first_hits, largest_ids, counts, cursors, ids, weights]
        launch(composite_extras, tables.tiles, arguments, device=records.device, block=THREADS)

    nothing = counts.new_empty(0)
    draw(nothing, nothing, records.new_empty(0))
    images = {"median_depth": medians, "first_hit_depth": first_hits, "largest_weight_id": largest_ids}
    for name in outputs:
        if name in images:
            for view, image in zip(views, cut_images(images[name], tables), strict=True):
                view[name] = image
    if "contributors" in outputs:
        bounds = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        # The host waits for these numbers.
        sizes = bounds[tables.pixel_bounds].diff().tolist()
        ids, weights = counts.new_empty(sum(sizes)), records.new_empty(sum(sizes))
        if len(ids):
            draw(bounds[:-1], ids, weights)
        parts = cut_images(counts, tables), ids.split(sizes), weights.split(sizes)
        for view, *pairs in zip(views, *parts, strict=True):
            view["contributors"] = Contributors(*pairs)
    return views


def cut_images(flat: Tensor, tables: Tables) -> list[Tensor]:
    """Return each view's image of flat ones."""
    parts = flat.split(tables.pixels)
    return [part.unflatten(0, size) for part, size in zip(parts, tables.sizes, strict=True)]
