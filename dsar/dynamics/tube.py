"""Between the texels of a garment's chart and the coarse grid of its simulation; both close around.

The grid's rows run from the chart's first to its last, its columns lie in the middle of equal parts.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor


class TubeSampling(NamedTuple):
    """Where the value at each of some places of a chart comes from."""

    indices: Int64[Tensor, "p 4"]
    """The four points of the grid around it, row by row."""
    weights: Float[Tensor, "p 4"]
    """Their weights, which sum to 1."""

    def __call__(self, values: Float[Tensor, "*b n c"]) -> Float[Tensor, "*b p c"]:
        """Return values of the grid's points at the places."""
        return (values[..., self.indices, :] * self.weights[:, :, None]).sum(-2)


def coarsen_tube(values: Float[Tensor, "h w c"], rows: int, columns: int) -> Float[Tensor, "r c2 c"]:
    """Return values of all texels of a chart on a coarser grid: weighted means around each of its points.

    Weights fall linearly to zero at the neighbouring point of the grid, so that what single texels err
    averages out.
    """
    height, width = values.shape[:2]
    down = torch.arange(height) * ((rows - 1) / max(height - 1, 1))
    across = (torch.arange(width) + 0.5) * (columns / width) - 0.5
    vertical = (1 - (torch.arange(rows)[:, None] - down).abs()).clamp_min(0)
    apart = (torch.arange(columns)[:, None] - across).abs()
    horizontal = (1 - torch.minimum(apart, columns - apart)).clamp_min(0)
    vertical, horizontal = (w / w.sum(1, keepdim=True) for w in (vertical, horizontal))
    return torch.einsum("rh,kw,hwc->rkc", vertical.to(values), horizontal.to(values), values)


def sample_tube(
    rows: Float[Tensor, " p"], columns: Float[Tensor, " p"], size: tuple[int, int], grid: tuple[int, int]
) -> TubeSampling:
    """Return the bilinear sampling of a grid at places of a chart.

    Args:
        rows: Places, in texel rows of the chart; 0 is the centre of its first.
        columns: In texel columns; 0 is the centre of the first.
        size: Rows and columns of texels.
        grid: Rows and columns of the grid.
    """
    down = rows * ((grid[0] - 1) / max(size[0] - 1, 1))
    across = (columns + 0.5) * (grid[1] / size[1]) - 0.5
    top = down.floor().clamp(0, max(grid[0] - 2, 0))
    left = across.floor()
    y, x = (down - top).clamp(0, 1), across - left
    top, left = top.long(), left.long() % grid[1]
    bottom, right = (top + 1).clamp_max(grid[0] - 1), (left + 1) % grid[1]
    indices = [row * grid[1] + column for row in (top, bottom) for column in (left, right)]
    weights = [v * u for v in (1 - y, y) for u in (1 - x, x)]
    return TubeSampling(torch.stack(indices, -1), torch.stack(weights, -1).float())
