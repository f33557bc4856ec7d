"""From the network's grid to texels: bilinear, and within a chart only."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from dsar.avatar.charts import Chart


class BilinearSampling(NamedTuple):
    """Where each texel's value comes from."""

    indices: Int32[Tensor, "n 4"]
    """Flat indices of the four grid cells around a texel."""
    weights: Float[Tensor, "n 4"]
    """Their weights, which sum to 1."""


def bilinear_sampling(
    rows: Int64[Tensor, " n"],
    columns: Int64[Tensor, " n"],
    upsample: int,
    width: int,
    charts: Sequence[Chart],
) -> BilinearSampling:
    """Return how texels are sampled from the grid.

    Charts end where they end: nothing is sampled from another. An island is clamped on all sides; a tube's
    first column follows its last.

    Args:
        rows: Texel rows.
        columns: Texel columns.
        upsample: A grid cell covers `upsample` x `upsample` texels.
        width: Columns of the grid.
        charts: Charts of the atlas, in texel rows.
    """
    starts = torch.tensor([chart.rows.start for chart in charts], device=rows.device)
    of_texel = torch.searchsorted(starts, rows, right=True) - 1
    cells = [chart.downsampled(upsample).rows for chart in charts]
    first = torch.tensor([r.start for r in cells], device=rows.device)[of_texel]
    last = torch.tensor([r.stop - 1 for r in cells], device=rows.device)[of_texel]
    tube = torch.tensor([chart.topology == "tube" for chart in charts], device=rows.device)[of_texel]
    down, across = ((texel + 0.5) / upsample - 0.5 for texel in (rows, columns))
    down = torch.minimum(torch.maximum(down, first), last)
    across = torch.where(tube, across, across.clamp(0, width - 1))
    top, left = down.floor().long(), across.floor().long()
    bottom, right = torch.minimum(top + 1, last), left + 1
    down, across = down - top, across - left
    left, right = (torch.where(tube, edge % width, edge.clamp_max(width - 1)) for edge in (left, right))
    indices = torch.stack([y * width + x for y in (top, bottom) for x in (left, right)], -1)
    weights = torch.stack([v * u for v in (1 - down, down) for u in (1 - across, across)], -1)
    return BilinearSampling(indices.int(), weights.float())


def sample_bilinear(maps: Float[Tensor, "b c h w"], sampling: BilinearSampling) -> Float[Tensor, "b n c"]:
    """Return map values at every texel."""
    indices, weights = sampling
    return (maps.flatten(2).transpose(1, 2)[:, indices] * weights[:, :, None]).sum(2)
