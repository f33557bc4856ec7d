"""Which rows of the window's attention are computed, and how they become the aggregate A."""

from jaxtyping import Bool, Float, Int64
from torch import Tensor


class Readout:
    """What reads the attention over a window whose frames lie at some positions in time."""

    reads_all_rows: bool
    """Whether every frame is a query, in the order of the positions; else the newest alone."""

    def query_embedding(
        self, embedding: Float[Tensor, "n c"], positions: Int64[Tensor, " n"]
    ) -> Float[Tensor, "q c"]:
        """Return the position embedding of each query."""
        raise NotImplementedError

    def future_mask(self, positions: Int64[Tensor, " n"]) -> Bool[Tensor, "q n"] | None:
        """Return which frames are hidden from each query; None: none is."""
        raise NotImplementedError

    def reduce(self, rows: Float[Tensor, "b q c h w"]) -> Float[Tensor, "b c h w"]:
        """Return A from the queries' rows."""
        raise NotImplementedError


class NewestRow(Readout):
    """The paper's readout: A_t is the row of frame t, so no other needs computing."""

    reads_all_rows = False

    def query_embedding(
        self, embedding: Float[Tensor, "n c"], positions: Int64[Tensor, " n"]
    ) -> Float[Tensor, "1 c"]:
        """Return the newest position's embedding."""
        return embedding[-1:]

    def future_mask(self, positions: Int64[Tensor, " n"]) -> None:
        """Return no mask: M_causal hides no frame from the newest (paper equation 10)."""
        return

    def reduce(self, rows: Float[Tensor, "b 1 c h w"]) -> Float[Tensor, "b c h w"]:
        """Return the one row."""
        return rows[:, 0]
