"""From a batch of Gaussians to the splats of its views and the list of splats of every tile."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from dsar.errors import RasterError
from dsar.raster.warp_backend.compiling import launch, launch_adjoint
from dsar.raster.warp_backend.kernels_binning import list_pairs, sum_pairs
from dsar.raster.warp_backend.kernels_projection import RECORD_SIZE, find_drawable, make_records
from dsar.raster.warp_backend.tables import Tables

_MAX_PAIRS = 2**28
"""Of splats and tiles. So many take 16 GB, and a backward pass 11 GB more."""


@dataclass(frozen=True)
class Splats:
    """The splats of all views, and which tiles they touch."""

    tables: Tables
    dilation: float
    antialiased: bool
    drawable: Int32[Tensor, " i"]
    """1 for instances that reach a pixel of their view, else 0."""
    records: Float[Tensor, "i 10"]
    """See kernels_projection; 0 where not drawable."""
    pair_ends: Int64[Tensor, " i"]
    """End of each instance's pairs with tiles, before sorting."""
    places: Int64[Tensor, " p"]
    """Where each pair was before sorting."""
    pairs: Int32[Tensor, " p"]
    """Instance of each pair, tile after tile, front to back."""
    starts: Int32[Tensor, " t1"]
    """Where each tile's pairs start, and the number of all."""

    @property
    def lists(self) -> list[Tensor]:
        """The first arguments of every kernel that blends."""
        return [self.tables.tile_ends, self.tables.views, self.starts, self.pairs, self.records]

    def culled(self) -> Int64[Tensor, " v"]:
        """Return how many Gaussians each view leaves out."""
        drawn = torch.cat([self.drawable.new_zeros(1), self.drawable]).cumsum(0)
        bounds = self.tables.instance_bounds
        return bounds.diff() - drawn[bounds].diff()


def make_splats(fields: Sequence[Tensor], tables: Tables, dilation: float, antialiased: bool) -> Splats:
    """Project Gaussians, given by the fields of all sets, and list the splats of every tile.

    Raises:
        RasterError: The list would not fit into memory.
    """
    device = fields[0].device
    records = fields[0].new_zeros(tables.instances, RECORD_SIZE)
    drawable = torch.empty(tables.instances, dtype=torch.int32, device=device)
    arguments = _projection_arguments(fields, tables, dilation, antialiased, drawable)
    launch(find_drawable, tables.gaussians, arguments, device=device)
    launch(make_records, tables.gaussians, [*arguments, records], device=device)

    no_ends = torch.empty(0, dtype=torch.int64, device=device)
    keys, owners, counts = no_ends, drawable.new_empty(0), torch.empty_like(drawable)
    arrays = [drawable, records, tables.instance_bounds, tables.views]
    launch(list_pairs, tables.instances, [*arrays, no_ends, counts, keys, owners], device=device)
    pair_ends = counts.cumsum(0)
    # The one time that the host waits for the device.
    total = int(pair_ends[-1]) if tables.instances else 0
    if total > _MAX_PAIRS:
        raise RasterError(
            f"rasterize: {int(drawable.sum())} Gaussians cover {total} tiles of 16 x 16 pixels in all, more "
            f"than the {_MAX_PAIRS} that can be listed; are scales in metres, and is the camera outside?"
        )
    if total:
        keys, owners = keys.new_empty(total), owners.new_empty(total)
        launch(list_pairs, tables.instances, [*arrays, pair_ends, counts, keys, owners], device=device)
    keys, places = keys.sort(stable=True)
    tiles = torch.arange(tables.tiles + 1, device=device) << 32
    starts = torch.searchsorted(keys, tiles, out_int32=True)
    return Splats(tables, dilation, antialiased, drawable, records, pair_ends, places, owners[places], starts)


def differentiate_splats(
    fields: Sequence[Tensor], splats: Splats, pair_sums: Float[Tensor, "p 10"]
) -> list[Tensor]:
    """Return the gradients of the fields, from those of every pair's record, in the order before sorting."""
    tables, device = splats.tables, pair_sums.device
    sums = torch.empty_like(splats.records)
    launch(sum_pairs, tables.instances, [splats.pair_ends, pair_sums, sums], device=device)
    arguments = _projection_arguments(fields, tables, splats.dilation, splats.antialiased, splats.drawable)
    gradients = [torch.zeros_like(field) for field in fields]
    between = [None] * (len(arguments) - len(fields))
    launch_adjoint(
        make_records, tables.gaussians, [*arguments, splats.records], [*gradients, *between, sums], device
    )
    return gradients


def _projection_arguments(
    fields: Sequence[Tensor], tables: Tables, dilation: float, antialiased: bool, drawable: Tensor
) -> list[Tensor | float | int]:
    """Return what both kernels of the projection take."""
    layout = [tables.set_ends, tables.first_views, tables.views, tables.cameras]
    return [*fields, *layout, dilation, int(antialiased), drawable]
