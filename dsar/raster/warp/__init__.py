"""The backend for GPUs that needs no compiler: Warp kernels under one autograd function, float32.

A whole batch of views goes through every kernel at once. The host waits for the device once, for the number of
pairs of tiles and splats; where contributors are asked for, once more. Images and gradients are the same to the
bit in every run. On the CPU the same kernels run in the same way, slowly: tests do that.
"""

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int, Int32, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from dsar.errors import RasterError
from dsar.raster.warp.compiling import launch, launch_adjoint, start_warp
from dsar.raster.warp.kernels_binning import list_pairs, sum_pairs
from dsar.raster.warp.kernels_compositing import THREADS, composite, composite_backward
from dsar.raster.warp.kernels_extras import composite_extras
from dsar.raster.warp.kernels_projection import find_drawable, make_records
from dsar.raster.warp.tables import Tables, make_tables
from dsar.types import Camera, Contributors, Gaussians, RenderOutput

MAX_PAIRS = 2**28
"""Of splats and tiles. So many take 16 GB, and a backward pass 11 GB more."""
RECORD = 10
"""Numbers in a splat's record (see kernels_projection)."""


@dataclass(frozen=True)
class _Pairs:
    """The lists of the tiles, front to back."""

    drawable: Int32[Tensor, " i"]
    """1 for instances that reach a pixel of their view, else 0."""
    ends: Int64[Tensor, " i"]
    """End of each instance's pairs, before sorting."""
    places: Int64[Tensor, " p"]
    """Where each pair was before sorting."""
    owners: Int32[Tensor, " p"]
    """Instance of each pair."""
    starts: Int32[Tensor, " t1"]
    """Where each tile's list starts, and the number of pairs."""


def rasterize_views_warp(
    gaussians: Sequence[Gaussians],
    cameras: Sequence[Sequence[Camera]],
    backgrounds: Float[Tensor, "v 3"] | None,
    dilation: float,
    antialiased: bool,
    outputs: Collection[str],
) -> list[list[RenderOutput]]:
    """Rasterise with Warp: `dsar.raster.rasterize_views` without its checks, for float32.

    Raises:
        RasterError: The list of tiles would not fit into memory.
    """
    start_warp()
    device = gaussians[0].means.device
    tables = make_tables([len(group) for group in gaussians], cameras, device)
    fields = [
        torch.cat([getattr(group, field.name) for group in gaussians]).contiguous()
        for field in dataclasses.fields(Gaussians)
    ]
    settings = _Settings(tables, dilation, antialiased, outputs)
    color, alpha, depth, drawable, *extras = _Rasterize.apply(*fields, backgrounds, settings)  # type: ignore[misc]
    images = [_cut(flat, tables) for flat in (color, alpha, depth)]
    drawn = [part.sum() for part in drawable.split(tables.counts)]
    more = _cut_extras(extras, tables, outputs)
    flat = iter(
        RenderOutput(*image, count - visible, **extra)
        for *image, count, visible, extra in zip(*images, tables.counts, drawn, more, strict=True)
    )
    return [[next(flat) for _ in group] for group in cameras]


@dataclass(frozen=True)
class _Settings:
    """What has no gradient."""

    tables: Tables
    dilation: float
    antialiased: bool
    outputs: Collection[str]


class _Rasterize(torch.autograd.Function):
    """Gaussians to flat (color, alpha, depth), what was drawn, and the requested outputs."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor | None, ...]:
        *tensors, backgrounds, settings = inputs
        tables, device = settings.tables, tensors[0].device
        projection, records, pairs = _project(tensors, settings)
        over = backgrounds if backgrounds is not None else records.new_zeros(len(tables.sizes), 3)
        size = sum(tables.pixels)
        color, alpha, depth, passed = (records.new_empty(size, *more) for more in ((3,), (), (), ()))
        lasts = torch.empty(size, dtype=torch.int32, device=device)
        lists = [tables.tile_ends, tables.views, pairs.starts, pairs.owners, records]
        launch(
            composite,
            tables.tiles,
            [*lists, over.contiguous(), color, alpha, depth, passed, lasts],
            device=device,
            block=THREADS,
        )
        extras = _draw_extras(lists, settings)
        ctx.mark_non_differentiable(pairs.drawable, *(extra for extra in extras if extra is not None))
        ctx.save_for_backward(*tensors, over, depth)
        ctx.settings, ctx.pairs, ctx.projection = settings, pairs, projection
        ctx.drawing = lists, passed, lasts
        return color, alpha, depth, pairs.drawable, *extras

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *v_outputs: Any) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        *tensors, over, depth = ctx.saved_tensors
        settings, pairs, (lists, passed, lasts) = ctx.settings, ctx.pairs, ctx.drawing
        v_color, v_alpha, v_depth = (v.contiguous() for v in v_outputs[:3])
        tables, device, records = settings.tables, over.device, lists[-1]
        pair_sums = records.new_zeros(len(pairs.owners), RECORD)
        sums = torch.empty_like(records)
        launch(
            composite_backward,
            tables.tiles,
            [*lists, over.contiguous(), depth, passed, lasts, v_color, v_alpha, v_depth, pairs.places, pair_sums],
            device=device,
            block=THREADS,
        )
        launch(sum_pairs, tables.instances, [pairs.ends, pair_sums, sums], device=device)
        gradients = [torch.zeros_like(tensor) for tensor in tensors]
        arguments = [*tensors, *ctx.projection, records]
        launch_adjoint(
            make_records,
            tables.gaussians,
            arguments,
            [*gradients, *(None for _ in ctx.projection), sums],
            device,
        )
        v_backgrounds = None
        if ctx.needs_input_grad[5]:
            shares = (passed[:, None] * v_color).split(tables.pixels)
            v_backgrounds = torch.stack([share.sum(0) for share in shares])
        return *gradients, v_backgrounds, None


def _project(
    tensors: Sequence[Tensor], settings: _Settings
) -> tuple[list[Any], Float[Tensor, "i 10"], _Pairs]:
    """Return the arguments of the projection between fields and records, the records, and the pairs."""
    tables, device = settings.tables, tensors[0].device
    records = tensors[0].new_zeros(tables.instances, RECORD)
    drawable = torch.empty(tables.instances, dtype=torch.int32, device=device)
    sets = [tables.set_ends, tables.first_views, tables.views, tables.cameras]
    between = [*sets, settings.dilation, int(settings.antialiased), drawable]
    launch(find_drawable, tables.gaussians, [*tensors, *between], device=device)
    launch(make_records, tables.gaussians, [*tensors, *between, records], device=device)
    return between, records, _list_pairs(records, drawable, tables)


def _list_pairs(
    records: Float[Tensor, "i 10"], drawable: Int32[Tensor, " i"], tables: Tables
) -> _Pairs:
    """Return each tile's list of splats."""
    device = records.device
    ends = drawable.new_zeros(0, dtype=torch.int64)
    keys, owners = ends, drawable.new_zeros(0)
    counts = torch.empty_like(drawable)
    # Of each view, in the order of instances.
    instance_ends = torch.tensor(tables.counts, dtype=torch.int32).cumsum(0, dtype=torch.int32).to(device)
    arrays = [drawable, records, instance_ends, tables.views]
    launch(list_pairs, tables.instances, [*arrays, ends, counts, keys, owners], device=device)
    ends = counts.cumsum(0)
    total = int(ends[-1]) if len(ends) else 0
    if total > MAX_PAIRS:
        raise RasterError(
            f"rasterize: {int(drawable.sum())} Gaussians cover {total} tiles of 16 x 16 pixels in all, more "
            f"than the {MAX_PAIRS} that can be listed; are scales in metres, and is the camera outside?"
        )
    if total:
        keys, owners = ends.new_empty(total), drawable.new_empty(total)
        launch(list_pairs, tables.instances, [*arrays, ends, counts, keys, owners], device=device)
    keys, places = keys.sort(stable=True)
    tiles = torch.arange(tables.tiles + 1, device=device) << 32
    return _Pairs(drawable, ends, places, owners[places], torch.searchsorted(keys, tiles, out_int32=True))


def _draw_extras(lists: list[Tensor], settings: _Settings) -> tuple[Tensor | None, ...]:
    """Return flat median and first-hit depths, Gaussians of the largest weights, and contributors.

    Contributors are counts, ids and weights. What is not requested is None.
    """
    if not settings.outputs:
        return (None,) * 6
    tables, records = settings.tables, lists[-1]
    size = sum(tables.pixels)
    medians, first_hits = records.new_empty(size), records.new_empty(size)
    largest_ids, counts = (records.new_empty(size, dtype=torch.int64) for _ in range(2))
    images = [medians, first_hits, largest_ids, counts]

    def draw(cursors: Int[Tensor, " *p"], ids: Int[Tensor, " m"], weights: Float[Tensor, " m"]) -> None:
        launch(
            composite_extras,
            tables.tiles,
            [*lists, *images, cursors, ids, weights],
            device=records.device,
            block=THREADS,
        )

    nothing = counts.new_empty(0)
    draw(nothing, nothing, records.new_empty(0))
    named = dict(zip(("median_depth", "first_hit_depth", "largest_weight_id"), images[:3], strict=True))
    requested = tuple(image if name in settings.outputs else None for name, image in named.items())
    if "contributors" not in settings.outputs:
        return *requested, None, None, None
    ends = counts.cumsum(0)
    total = int(ends[-1])
    ids, weights = counts.new_empty(total), records.new_empty(total)
    if total:
        draw(ends - counts, ids, weights)
    return *requested, counts, ids, weights


def _cut(flat: Tensor, tables: Tables) -> list[Tensor]:
    """Return each view's image of flat ones."""
    parts = flat.split(tables.pixels)
    return [part.unflatten(0, size) for part, size in zip(parts, tables.sizes, strict=True)]


def _cut_extras(
    extras: Sequence[Tensor | None], tables: Tables, outputs: Collection[str]
) -> list[dict[str, Any]]:
    """Return each view's requested outputs by name."""
    *images, counts, ids, weights = extras
    views: list[dict[str, Any]] = [{} for _ in tables.sizes]
    for name, flat in zip(("median_depth", "first_hit_depth", "largest_weight_id"), images, strict=True):
        for view, image in zip(views, _cut(flat, tables) if flat is not None else (), strict=False):
            view[name] = image
    if counts is not None and ids is not None and weights is not None:
        cut = _cut(counts, tables)
        sizes = torch.stack([image.sum() for image in cut]).tolist()
        for view, *pairs in zip(views, cut, ids.split(sizes), weights.split(sizes), strict=True):
            view["contributors"] = Contributors(*pairs)
    return views
