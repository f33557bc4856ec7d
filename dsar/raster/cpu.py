"""The fast backend on the CPU: Numba kernels under one autograd function, float32.

Gradients are written by hand and checked against dsar.raster.reference. Results are the same to the bit
for any number of threads (`numba.set_num_threads`); with one thread, all runs in the caller's.
"""

import dataclasses
import logging
import time
from collections.abc import Collection
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from dsar.errors import RasterError
from dsar.raster.conventions import EPS_2D
from dsar.raster.kernels_auxiliary import composite_auxiliary_part
from dsar.raster.kernels_binning import (
    FIRST_ROWS,
    count_intersections_part,
    emit_intersections_part,
    prefix_sum,
    reduce_sums_part,
    sort_by_depth,
)
from dsar.raster.kernels_compositing import composite_backward_part, composite_part
from dsar.raster.kernels_projection import project_part
from dsar.raster.kernels_projection_backward import project_backward_part
from dsar.raster.kernels_shading import shade_backward_part, shade_part
from dsar.raster.parallel import part_count, run_parts
from dsar.raster.tiles import RECORD_SIZE, SUMS_SIZE, TILE
from dsar.types import Camera, Contributors, Gaussians, RenderOutput

_log = logging.getLogger(__name__)
_MAX_PAIRS = 2**28
"""Of splats and tiles. Indices are 32-bit, and a backward pass keeps 52 bytes a pair: so many take 14 GB."""
_NO_IMAGE = np.empty((0, 0), np.float32)
_NO_COLOR = np.empty((0, 0, 3), np.float32)
_BLACK = np.zeros(3, np.float32)


def rasterize_cpu(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Tensor, "3"] | None,
    dilation: float,
    antialiased: bool,
    outputs: Collection[str],
) -> RenderOutput:
    """Rasterise with Numba: `dsar.raster.rasterize` without its checks, for float32 in main memory."""
    _load_kernels()
    return _apply(gaussians, background, _Settings(camera, dilation, antialiased, outputs))


@dataclass(frozen=True)
class _Settings:
    """What has no gradient."""

    camera: Camera
    dilation: float = EPS_2D
    antialiased: bool = False
    outputs: Collection[str] = ()


def _apply(gaussians: Gaussians, background: Tensor | None, settings: _Settings) -> RenderOutput:
    fields = (getattr(gaussians, field.name) for field in dataclasses.fields(gaussians))
    images = _Rasterize.apply(*fields, background, settings)
    color, alpha, depth, culled, median, first_hit, largest_id, *pairs = images  # type: ignore[misc]  # untyped
    contributors = Contributors(*pairs) if pairs[0] is not None else None
    return RenderOutput(color, alpha, depth, culled, median, first_hit, largest_id, contributors)


class _Rasterize(torch.autograd.Function):
    """Gaussians to (color, alpha, depth) and, without gradients, the requested outputs."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor | None, ...]:
        *tensors, settings = inputs
        ctx.set_materialize_grads(False)
        arrays, background = [_as_array(tensor) for tensor in tensors[:5]], _as_array(tensors[5])
        n, width, height = len(arrays[0]), settings.camera.width, settings.camera.height
        packed_camera, center = _pack_camera(settings)
        records = _new_records(n)
        bounds = records.view(np.int32)[:, -4:]
        run_parts(_project_and_shade_part, *arrays, packed_camera, center, width, height, records, bounds)
        tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
        order = sort_by_depth(records, bounds)
        bins = _bin_into_tiles(order, records, bounds, tiles_x, tiles_y)
        outputs = torch.empty(height, width, 3), torch.empty(height, width), torch.empty(height, width)
        images = [output.numpy() for output in outputs]
        run_parts(composite_part, records, bins[0], bins[1], tiles_x, background, *images)
        culled = torch.tensor(n - len(order))
        extras = _auxiliary_pass(records, bins[0], bins[1], tiles_x, settings)
        ctx.mark_non_differentiable(culled, *(extra for extra in extras if extra is not None))
        ctx.save_for_backward(*tensors, *outputs)
        ctx.splats = records, bounds, packed_camera, center
        ctx.bins = *bins, tiles_x
        return *outputs, culled, *extras

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *v_outputs: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        *tensors, color, alpha, depth = ctx.saved_tensors
        arrays = [_as_array(tensor) for tensor in tensors[:5]]
        records, bounds, packed_camera, center = ctx.splats
        tile_offsets, pairs, splat_offsets, pair_ids, tiles_x = ctx.bins
        height, width = alpha.shape
        images = color.numpy(), alpha.numpy(), depth.numpy()
        v_images = map(_as_array, v_outputs[:3], (_NO_COLOR, _NO_IMAGE, _NO_IMAGE))
        pair_sums = np.empty((len(pairs), SUMS_SIZE), np.float32)
        run_parts(
            composite_backward_part, records, tile_offsets, pairs, tiles_x, *images, *v_images, pair_sums
        )
        # Zeros from NumPy: torch would fill them with OpenMP threads, which then spin on the cores we need.
        gradients = [np.zeros(array.shape, np.float32) for array in arrays]
        sums = np.empty((len(bounds), SUMS_SIZE), np.float32)
        run_parts(_backward_part, *arrays, packed_camera, center, width, height, bounds, splat_offsets,
                  pair_ids, pair_sums, sums, *gradients)  # fmt: skip
        v_background = None
        if ctx.needs_input_grad[5] and v_outputs[0] is not None:
            v_background = torch.einsum("hw,hwc->c", 1 - alpha, v_outputs[0])
        return *map(torch.from_numpy, gradients), v_background, None


def _new_records(count: int) -> np.ndarray:
    """Return room for the records of splats, each of which fills a cache line and ends with its bounds.

    From NumPy, which asks for huge pages: in order of depth records are read from all over, and with small
    pages finding them takes longer than reading them.
    """
    lines = np.empty((count + 1) * RECORD_SIZE, np.float32)
    first = -lines.ctypes.data % (4 * RECORD_SIZE) // 4
    return lines[first : first + count * RECORD_SIZE].reshape(count, RECORD_SIZE)


def _bin_into_tiles(
    order: np.ndarray, records: np.ndarray, bounds: np.ndarray, tiles_x: int, tiles_y: int
) -> tuple[np.ndarray, ...]:
    """Return each tile's list of splats, front to back.

    Returns:
        tile_offsets: [tiles + 1] where each tile's list starts.
        pairs: [p, 2] splat, and set of the tile's blocks that it touches.
        splat_offsets: [n + 1] where each splat's pairs start.
        pair_ids: [p] indices of each splat's pairs.
    """
    cursors = np.empty((part_count(), tiles_x * tiles_y), np.int32)
    tiles = np.zeros(len(bounds), np.int32)
    run_parts(count_intersections_part, order, records, bounds, tiles_x, cursors, tiles)
    total = int(tiles.sum(dtype=np.int64))
    if total > _MAX_PAIRS:
        raise RasterError(
            f"rasterize: {len(order)} Gaussians cover {total} tiles of {TILE} x {TILE} pixels in all, more "
            f"than the {_MAX_PAIRS} that can be listed; are scales in metres, and is the camera outside?"
        )
    tile_offsets, splat_offsets = prefix_sum(cursors, tiles)
    pairs, pair_ids = np.empty((tile_offsets[-1], 2), np.int32), np.empty(tile_offsets[-1], np.int32)
    run_parts(emit_intersections_part, order, records, bounds, tiles_x, FIRST_ROWS, cursors, splat_offsets,
              pairs, pair_ids)  # fmt: skip
    return tile_offsets, pairs, splat_offsets, pair_ids


def _auxiliary_pass(
    records: np.ndarray, tile_offsets: np.ndarray, pairs: np.ndarray, tiles_x: int, settings: _Settings
) -> tuple[Tensor | None, ...]:
    """Return median and first-hit depths, splats of the largest weights, and contributors.

    Contributors are counts, ids and weights. What is not requested is None.
    """
    if not settings.outputs:
        return (None,) * 6
    width, height = settings.camera.width, settings.camera.height
    medians, first_hits = torch.empty(height, width), torch.empty(height, width)
    largest_id, counts = (torch.empty(height, width, dtype=torch.int64) for _ in range(2))
    ids, weights = torch.empty(0, dtype=torch.int64), torch.empty(0)
    starts = np.zeros(height * width, np.int64)

    def run_pass() -> None:
        run_parts(
            composite_auxiliary_part,
            records,
            tile_offsets,
            pairs,
            tiles_x,
            starts,
            medians.numpy(),
            first_hits.numpy(),
            largest_id.numpy(),
            counts.numpy(),
            ids.numpy(),
            weights.numpy(),
        )

    run_pass()
    images = {"median_depth": medians, "first_hit_depth": first_hits, "largest_weight_id": largest_id}
    requested = tuple(image if name in settings.outputs else None for name, image in images.items())
    if "contributors" not in settings.outputs:
        return *requested, None, None, None
    ends = counts.flatten().cumsum(0)
    starts = (ends - counts.flatten()).numpy()
    ids, weights = torch.empty(int(ends[-1]), dtype=torch.int64), torch.empty(int(ends[-1]))
    run_pass()
    return *requested, counts, ids, weights


def _project_and_shade_part(
    part, parts, means, rotations, scales, opacities, harmonics,
    packed_camera, center, width, height, records, bounds,
):  # fmt: skip
    """Project and shade one part of the Gaussians: write their records and bounds."""
    project_part(
        part, parts, means, rotations, scales, opacities, packed_camera, width, height, records, bounds
    )
    shade_part(part, parts, means, harmonics, center, records, bounds)


def _backward_part(
    part, parts, means, rotations, scales, opacities, harmonics,
    packed_camera, center, width, height, bounds, splat_offsets, pair_ids, pair_sums, sums,
    v_means, v_rotations, v_scales, v_opacities, v_harmonics,
):  # fmt: skip
    """Bring the gradients of one part's splats back to their Gaussians."""
    reduce_sums_part(part, parts, splat_offsets, pair_ids, pair_sums, sums)
    project_backward_part(part, parts, means, rotations, scales, opacities, packed_camera, width, height,
                          bounds, sums, v_means, v_rotations, v_scales, v_opacities)  # fmt: skip
    shade_backward_part(part, parts, means, harmonics, center, bounds, sums, v_harmonics, v_means)


def _as_array(tensor: Tensor | None, missing: np.ndarray = _BLACK) -> np.ndarray:
    """Return a tensor's values as a C-contiguous array (shared where possible), or `missing` for None."""
    return missing if tensor is None else tensor.detach().contiguous().numpy()


def _pack_camera(settings: _Settings) -> tuple[np.ndarray, np.ndarray]:
    """Return the kernels' camera (18 numbers, see kernels_projection) and its centre in the world."""
    transform, K = (t.detach().cpu().numpy() for t in (settings.camera.T_camera_world, settings.camera.K))
    rotation, translation = transform[:3, :3], transform[:3, 3]
    packed = np.empty(18, np.float32)
    packed[:9], packed[9:12] = rotation.ravel(), translation
    packed[12:16] = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    packed[16:] = settings.dilation, settings.antialiased
    return packed, (-rotation.T @ translation).astype(np.float32)


@cache
def _load_kernels() -> None:
    """Load or compile the kernels by rendering, so that the wait can be announced."""
    _log.info("Loading the rasteriser; its first use on a machine compiles it (about 30 s)")
    start = time.perf_counter()
    camera = Camera(torch.eye(3), torch.eye(4), 8, 8, "one")
    # Whatever mode the first caller is in, the backward kernels are wanted too.
    with torch.inference_mode(False), torch.enable_grad():
        # Two: the bounds of a single one look like an array without gaps, which has kernels of its own.
        two = Gaussians(
            torch.tensor([[0.0, 0.0, 1.0]] * 2), torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2), torch.ones(2, 3),
            torch.full((2,), 0.5), torch.zeros(2, 1, 3),
        ).map(Tensor.requires_grad_)  # fmt: skip
        settings = _Settings(camera, outputs=("median_depth", "contributors"))
        _apply(two, None, settings).color.sum().backward()
    _log.info("Rasteriser ready after %.1f s", time.perf_counter() - start)
