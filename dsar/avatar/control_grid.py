"""Control points: one point of the surface for each pixel of the network's maps."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from dsar.avatar.bilinear import BilinearSampling, bilinear_sampling
from dsar.avatar.charts import Atlas, Chart


class ControlGrid(nn.Module):
    """The control points, where they lie on the network's grid, and how texels are sampled from it."""

    cells: Tensor
    """Flat grid index of each control point, ascending: [p]."""
    points: Tensor
    """Rest positions, metres: [p, 3]."""
    weights: Tensor
    """Skin weights; rows sum to 1: [p, j]."""
    frames: Tensor
    """Rest axes of the surface as columns: side, up along the surface, outward normal: [p, 3, 3]."""
    axes: Tensor
    """Rest axes of the network's offsets as columns: [p, 3, 3]."""
    basis: Tensor
    """Skin weights times homogeneous rest positions: bone transforms times them are posed points: [p, 4j]."""
    edges: Tensor
    """Pairs of control points that are neighbours on the surface: [e, 2]."""
    bilinear_indices: Tensor
    bilinear_weights: Tensor

    def __init__(self, atlas: Atlas, upsample: int, *, surface_axes: bool) -> None:
        """Take for each cell, of `upsample` x `upsample` texels, the texel nearest to its centre.

        Offsets are along the axes of the surface, or else along those of the body.
        """
        super().__init__()
        self.charts = tuple(chart.downsampled(upsample) for chart in atlas.charts)
        self.size = (atlas.height // upsample, atlas.width // upsample)
        cells, nearest = assign_control_cells(atlas, upsample)
        points, weights, frames = atlas.positions[nearest], atlas.weights[nearest], atlas.frames[nearest]
        self.register_buffer("cells", cells)
        self.register_buffer("points", points)
        self.register_buffer("weights", weights)
        self.register_buffer("frames", frames)
        axes = frames.clone() if surface_axes else torch.eye(3).repeat(len(cells), 1, 1)
        self.register_buffer("axes", axes, persistent=False)
        basis = weights[:, :, None] * nn.functional.pad(points, (0, 1), value=1.0)[:, None]
        self.register_buffer("basis", basis.flatten(1), persistent=False)
        edges = find_surface_edges(cells, self.size, points, self.charts)
        self.register_buffer("edges", edges, persistent=False)
        rows, columns = atlas.texels // atlas.width, atlas.texels % atlas.width
        sampling = bilinear_sampling(rows, columns, upsample, self.size[1], atlas.charts)
        self.register_buffer("bilinear_indices", sampling.indices, persistent=False)
        self.register_buffer("bilinear_weights", sampling.weights, persistent=False)

    @property
    def sampling(self) -> BilinearSampling:
        """How each texel is sampled from maps on the grid."""
        return BilinearSampling(self.bilinear_indices, self.bilinear_weights)

    @property
    def occupied(self) -> Bool[Tensor, "h w"]:
        """The grid's cells that have a control point."""
        occupied = self.cells.new_zeros(self.size[0] * self.size[1], dtype=torch.bool)
        occupied[self.cells] = True
        return occupied.reshape(self.size)

    def on_charts(self, charts: Sequence[Chart]) -> Int64[Tensor, " g"]:
        """Return which control points lie on some of `self.charts`."""
        rows = self.cells // self.size[1]
        return torch.stack([chart.holds(rows) for chart in charts] or [rows < 0]).any(0).nonzero().squeeze(1)

    def gather(self, maps: Float[Tensor, "b c h w"]) -> Float[Tensor, "b p c"]:
        """Return the values of maps at the control points."""
        return maps.flatten(2)[:, :, self.cells].transpose(1, 2)

    def scatter(self, values: Float[Tensor, "b p c"]) -> Float[Tensor, "b c h w"]:
        """Return maps of values at the control points, 0 elsewhere."""
        maps = values.new_zeros(len(values), values.shape[2], self.size[0] * self.size[1])
        return maps.index_copy(2, self.cells, values.transpose(1, 2)).unflatten(2, self.size)


def assign_control_cells(atlas: Atlas, upsample: int) -> tuple[Int64[Tensor, " p"], Int64[Tensor, " p"]]:
    """Return the network pixels that hold texels, and of each the texel nearest to its centre."""
    rows, columns = atlas.texels // atlas.width, atlas.texels % atlas.width
    width = atlas.width // upsample
    cell = rows // upsample * width + columns // upsample
    center = (upsample - 1) / 2
    distance = (rows % upsample - center).square() + (columns % upsample - center).square()
    order = (cell.double() * 1e6 + distance).argsort(stable=True)
    cells, counts = cell[order].unique_consecutive(return_counts=True)
    return cells, order[counts.cumsum(0) - counts]


def find_surface_edges(
    cells: Int64[Tensor, " p"], size: tuple[int, int], points: Float[Tensor, "p 3"], charts: Sequence[Chart]
) -> Int64[Tensor, "e 2"]:
    """Return the pairs of points that are neighbours on the surface.

    They are neighbours on the grid, on the same chart, and not much farther apart than is usual: islands of
    the body's UV map stay apart. A tube's first column follows its last.

    Args:
        cells: Flat grid indices of the points.
        size: Rows and columns of the grid.
        points: Positions, metres.
        charts: The grid's charts.
    """
    height, width = size
    index = cells.new_full((height * width,), -1)
    index[cells] = torch.arange(len(cells), device=cells.device)
    grid = index.reshape(size)
    apart = cells.new_zeros(2, *size, dtype=torch.bool)
    for chart in charts:
        apart[0, chart.rows.start : chart.rows.stop, -1] = chart.topology == "island"
        apart[1, chart.rows.stop - 1] = True
    right, below = torch.stack([grid, grid.roll(-1, 1)], -1), torch.stack([grid[:-1], grid[1:]], -1)
    pairs = torch.cat([right.reshape(-1, 2), below.reshape(-1, 2)])
    apart = torch.cat([apart[0].flatten(), apart[1, :-1].flatten()])[(pairs >= 0).all(1)]
    pairs = pairs[(pairs >= 0).all(1)]
    if not len(pairs):
        return pairs
    distance = (points[pairs[:, 0]] - points[pairs[:, 1]]).norm(dim=1)
    return pairs[(distance <= 2 * distance.median()) & ~apart]
