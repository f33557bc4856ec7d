"""All rows of the window's attention are read, where the paper reads the newest frame's."""

from jaxtyping import Bool, Float, Int64
from torch import Tensor

from dsar.network.readout import Readout


class MeanOfRows(Readout):
    """The aggregate is the mean of what every frame of the window finds."""

    reads_all_rows = True

    def __init__(self, *, causal: bool) -> None:
        """Hide the future of every frame from it, if `causal`; else attention is bidirectional."""
        self.causal = causal

    def query_embedding(
        self, embedding: Float[Tensor, "n c"], positions: Int64[Tensor, " n"]
    ) -> Float[Tensor, "n c"]:
        """Return the position embeddings of all frames."""
        return embedding[positions]

    def future_mask(self, positions: Int64[Tensor, " n"]) -> Bool[Tensor, "n n"] | None:
        """Return which frames lie in the future of each; None: none is hidden."""
        return positions[:, None] < positions if self.causal else None

    def reduce(self, rows: Float[Tensor, "b n c h w"]) -> Float[Tensor, "b c h w"]:
        """Return the mean of all rows."""
        return rows.mean(1)
