"""Between the texels of a garment's chart and the coarse grid of its simulation; both close around.

The grid's rows divide the way down the cloth evenly, from the chart's first to its last row; its columns lie
in the middle of equal parts. A chart may reach below the hem, where the template crumples what is left over:
its rows of texels are no measure of cloth.
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


_RIDGE = 1e-3
"""Weight, in texels, of the means that a fit keeps to where texels leave it open."""


def places_down(points: Float[Tensor, "h w 3"], rows: int) -> Float[Tensor, " h"]:
    """Return where the texel rows of a tube lie among the rows of a grid: 0 is the first, rows - 1 the last.

    Args:
        points: The tube's texels, metres, Y up.
        rows: Rows of the grid, which divide the mean profile (height and radius) evenly.
    """
    apart = (points - points.mean(1, keepdim=True))[..., [0, 2]].norm(dim=-1)
    profile = torch.stack([points[..., 1].mean(1), apart.mean(1)], -1)
    # Rows at one place still follow each other.
    steps = profile.diff(dim=0).norm(dim=-1) + 1e-6
    way = torch.cat([steps.new_zeros(1), steps.cumsum(0)])
    return way * ((rows - 1) / way[-1].clamp_min(1e-6))


def average_tube(
    values: Float[Tensor, "h w c"], places: Float[Tensor, " h"], grid: tuple[int, int]
) -> Float[Tensor, "r c2 c"]:
    """Return weighted means of a tube's texels around each point of a grid.

    Weights fall linearly to zero at the neighbouring point of the grid.

    Args:
        values: Of the texels.
        places: Where their rows lie among those of the grid, see `places_down`.
        grid: Its rows and columns.
    """
    width, (rows, columns) = values.shape[1], grid
    across = (torch.arange(width) + 0.5) * (columns / width) - 0.5
    reach = places.diff().max().clamp_min(1) if len(places) > 1 else rows
    vertical = (1 - (torch.arange(rows)[:, None] - places).abs() / reach).clamp_min(0)
    apart = (torch.arange(columns)[:, None] - across).abs()
    horizontal = (1 - torch.minimum(apart, columns - apart) / max(1.0, columns / width)).clamp_min(0)
    vertical, horizontal = (w / w.sum(1, keepdim=True) for w in (vertical, horizontal))
    return torch.einsum("rh,kw,hwc->rkc", vertical.to(values), horizontal.to(values), values)


def fit_tube(
    values: Float[Tensor, "h w c"], places: Float[Tensor, " h"], grid: tuple[int, int]
) -> Float[Tensor, "r c2 c"]:
    """Return the values of a grid that give a tube's texels back best (least squares); see `average_tube`.

    Means shrink what they average: edges move inwards, and folds get shallow.
    """
    width = values.shape[1]
    columns = torch.arange(width).expand(len(values), width).flatten()
    sampling = sample_tube(places.repeat_interleave(width), columns.to(places), width, grid)
    indices, weights = sampling.indices, sampling.weights.double()
    means = average_tube(values, places, grid).flatten(0, 1).double()
    left = values.flatten(0, 1).double() - (means[indices] * weights[..., None]).sum(1)
    normal = _RIDGE * torch.eye(len(means), dtype=torch.float64)
    pairs = weights[:, :, None] * weights[:, None, :]
    rows, others = indices[:, :, None].expand_as(pairs), indices[:, None, :].expand_as(pairs)
    normal.index_put_((rows.flatten(), others.flatten()), pairs.flatten(), accumulate=True)
    right = torch.zeros_like(means)
    right.index_add_(0, indices.flatten(), (weights[..., None] * left[:, None]).flatten(0, 1))
    return (means + torch.linalg.solve(normal, right)).to(values).unflatten(0, grid)


def sample_tube(
    down: Float[Tensor, " p"], columns: Float[Tensor, " p"], width: int, grid: tuple[int, int]
) -> TubeSampling:
    """Return the bilinear sampling of a grid at places of a chart.

    Args:
        down: Places among the grid's rows.
        columns: In texel columns of the chart; 0 is the centre of the first.
        width: Columns of texels.
        grid: Rows and columns of the grid.
    """
    across = (columns + 0.5) * (grid[1] / width) - 0.5
    top = down.floor().clamp(0, max(grid[0] - 2, 0))
    left = across.floor()
    y, x = (down - top).clamp(0, 1), across - left
    top, left = top.long(), left.long() % grid[1]
    bottom, right = (top + 1).clamp_max(grid[0] - 1), (left + 1) % grid[1]
    indices = [row * grid[1] + column for row in (top, bottom) for column in (left, right)]
    weights = [v * u for v in (1 - y, y) for u in (1 - x, x)]
    return TubeSampling(torch.stack(indices, -1), torch.stack(weights, -1).float())
