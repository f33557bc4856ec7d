"""The backend for GPUs that needs no compiler: Warp kernels under one autograd function, float32.

A whole batch of views goes through every kernel at once. The host waits for the device once, for the number
of pairs of tiles and splats; where contributors are asked for, once more. Images and gradients are the same
to the bit in every run. On the CPU the same kernels run in the same blocks of threads: for tests.
"""

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from dsar.raster.warp_backend.compiling import launch, start_warp
from dsar.raster.warp_backend.extras import cut_images, draw_extras
from dsar.raster.warp_backend.kernels_compositing import THREADS, composite, composite_backward
from dsar.raster.warp_backend.kernels_projection import RECORD_SIZE
from dsar.raster.warp_backend.splats import differentiate_splats, make_splats
from dsar.raster.warp_backend.tables import make_tables
from dsar.types import Camera, Gaussians, RenderOutput


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
        ConfigError: Warp is too old, or cannot use the GPU.
        RasterError: The list of tiles would not fit into memory.
    """
    device = gaussians[0].means.device
    start_warp(device)
    tables = make_tables([len(group) for group in gaussians], cameras, device)
    names = [field.name for field in dataclasses.fields(Gaussians)]
    fields = [_join([getattr(group, name) for group in gaussians]) for name in names]
    splats = make_splats([field.detach() for field in fields], tables, dilation, antialiased)
    if backgrounds is None:
        backgrounds = splats.records.new_zeros(len(tables.sizes), 3)
    flat: Any = _Blend.apply(*fields, backgrounds, splats)
    images = (cut_images(image, tables) for image in flat)
    parts = zip(*images, splats.culled().unbind(), draw_extras(splats, outputs), strict=True)
    views = iter(
        RenderOutput(color, alpha, depth, culled, **extras) for color, alpha, depth, culled, extras in parts
    )
    return [[next(views) for _ in group] for group in cameras]


def _join(parts: Sequence[Tensor]) -> Tensor:
    """Return the rows of all sets one after another, without a copy where there is only one set."""
    return torch.cat(list(parts)) if len(parts) > 1 else parts[0].contiguous()


class _Blend(torch.autograd.Function):
    """Splats to flat images of color, alpha and depth, differentiable by what the splats were made of."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        *fields, backgrounds, splats = inputs
        size, tables = sum(splats.tables.pixels), splats.tables
        backgrounds = backgrounds.contiguous()
        color, alpha, depth, passed = (splats.records.new_empty(size, *more) for more in ((3,), (), (), ()))
        lasts = torch.empty(size, dtype=torch.int32, device=passed.device)
        arguments = [*splats.lists, backgrounds, color, alpha, depth, passed, lasts]
        launch(composite, tables.tiles, arguments, device=passed.device, block=THREADS)
        ctx.save_for_backward(*fields, backgrounds, depth, passed, lasts)
        ctx.splats = splats
        return color, alpha, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *v_images: Any) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        *fields, backgrounds, depth, passed, lasts = ctx.saved_tensors
        splats = ctx.splats
        v_color, v_alpha, v_depth = (image.contiguous() for image in v_images)
        pair_sums = passed.new_zeros(len(splats.pairs), RECORD_SIZE)
        arguments = [*splats.lists, backgrounds, depth, passed, lasts, v_color, v_alpha, v_depth]
        launch(
            composite_backward,
            splats.tables.tiles,
            [*arguments, splats.places, pair_sums],
            device=passed.device,
            block=THREADS,
        )
        v_backgrounds = None
        if ctx.needs_input_grad[len(fields)]:
            shares = (passed[:, None] * v_color).split(splats.tables.pixels)
            v_backgrounds = torch.stack([share.sum(0) for share in shares])
        return *differentiate_splats(fields, splats, pair_sums), v_backgrounds, None
