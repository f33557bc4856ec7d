"""What depends only on the weights and on where in time the frames of a window lie."""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from dsar.network.temporal import TemporalAttention


@dataclass(frozen=True)
class PositionTable:
    """What depends on the positions of a window's frames: key and value biases, weights of temporal filters.

    Training holds the frames in order. In a session's ring the order depends on which entry is the newest: it
    computes the table of all orders once, and selects one a step.
    """

    positions: Int64[Tensor, "*p n"]
    """Of each frame: 0 the oldest, n - 1 the newest."""
    table: Float[Tensor, "*p n _"]
    """Side by side: what each frame's position adds to its key and value, and its weights in the aggregates
    of shallow levels, finest first."""
    widths: tuple[int, ...]
    """Their channels."""

    @classmethod
    def build(
        cls,
        attention: TemporalAttention,
        aggregation_weights: Iterable[Float[Tensor, "n _"]],
        positions: Int64[Tensor, "*p n"],
    ) -> "PositionTable":
        """Return the table of frames at given positions, from the weights of the layers."""
        columns = [attention.position_bias(positions), *(level[positions] for level in aggregation_weights)]
        return cls(positions, torch.cat(columns, -1), tuple(column.shape[-1] for column in columns))

    def select(self, index: Int64[Tensor, "1"]) -> "PositionTable":
        """Return one of several orders."""
        positions = self.positions.index_select(0, index)[0]
        return PositionTable(positions, self.table.index_select(0, index)[0], self.widths)

    @property
    def key_value_bias(self) -> Float[Tensor, "*p n d"]:
        """What positions add to keys and values."""
        return self.table[..., : self.widths[0]]

    @property
    def aggregation_weights(self) -> tuple[Float[Tensor, "*p n _"], ...]:
        """The frames' weights at each shallow level, finest first."""
        return self.table.split(self.widths, -1)[1:]
