"""Motion-adaptive temporal aggregation and the memory bank (paper sections 3.3 and 3.4).

Frames come oldest first, or in any other `order`: then entry i is the frame of age order[i], 0 the oldest,
n - 1 the newest.
"""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from dsar.network.layers import ConvBlock, conv, projection

Order = Int64[Tensor, " n"] | None


class MotionEmbedding(nn.Module):
    """Embed the motion magnitude V into feature space (paper equation 7)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.block = ConvBlock(1, channels // 2)
        self.out = conv(channels // 2, channels)

    def forward(self, magnitude: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b c h w"]:
        """Return the embedding of a magnitude map in units of its standard deviation."""
        return self.out(self.block(magnitude))


class TemporalAttention(nn.Module):
    """Multi-head attention of frames to frames, at each pixel by itself (paper equations 9-12).

    A learnt embedding of a frame's age is part of what its key and value are made of. Both are linear, so
    they can be projected once and given their ages as they grow older.
    """

    def __init__(self, channels: int, heads: int, length: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = projection(channels, channels)
        self.key = projection(channels, channels)
        self.value = projection(channels, channels)
        self.out = projection(channels, channels)
        self.age = nn.Parameter(0.02 * torch.randn(length, channels))

    def project(
        self, frames: Float[Tensor, "b n c h w"]
    ) -> tuple[Float[Tensor, "b n c h w"], Float[Tensor, "b n c h w"]]:
        """Return keys and values of frames, without their ages."""
        flat = frames.flatten(0, 1)
        return (
            self.key(flat).unflatten(0, frames.shape[:2]),
            self.value(flat).unflatten(0, frames.shape[:2]),
        )

    def ages(self, order: Order = None) -> Float[Tensor, "2 n c"]:
        """Return what their ages add to the keys and to the values of frames."""
        ages = self.age if order is None else self.age[order]
        return torch.stack([ages @ layer.weight[:, :, 0, 0].mT for layer in (self.key, self.value)])

    def attend(
        self,
        queries: Float[Tensor, "b q c h w"],
        keys: Float[Tensor, "b n c h w"],
        values: Float[Tensor, "b n c h w"],
        ages: Float[Tensor, "2 n c"],
        *,
        common: Float[Tensor, "b c h w"] | None = None,
        younger: Bool[Tensor, "q n"] | None = None,
    ) -> Float[Tensor, "b q c h w"]:
        """Return what each query finds among frames given by `project` and `ages`.

        `common` was to be added to every frame before they were projected. What is `younger` than a query is
        hidden from it.
        """
        b, q, c, h, w = queries.shape
        late = ages[:, None, :, :, None, None]
        if common is not None:
            layers = (self.key, self.value)
            late = late + torch.stack([nn.functional.conv2d(common, x.weight) for x in layers])[:, :, None]
        keys, values = keys + late[0], values + late[1]
        split = (self.heads, c // self.heads, h, w)
        asked = self.query(queries.flatten(0, 1)).reshape(b, q, 1, *split)
        keys, values = (x.reshape(b, 1, -1, *split) for x in (keys, values))
        scores = (asked * keys).sum(4, keepdim=True) * (c // self.heads) ** -0.5
        if younger is not None:
            scores = scores.masked_fill(younger[:, :, None, None, None, None], -torch.inf)
        mixed = (scores.softmax(2) * values).sum(2).reshape(b * q, c, h, w)
        return self.out(mixed).unflatten(0, (b, q))


class MemoryBank(nn.Module):
    """Mix the aggregate of the window with what the bank recalls (paper equations 12-13)."""

    def __init__(self, channels: int, heads: int, length: int, recall: float) -> None:
        super().__init__()
        self.attention = TemporalAttention(channels, heads, length)
        self.recall_logit = nn.Parameter(torch.tensor(recall).logit())

    def forward(
        self,
        aggregate: Float[Tensor, "b c h w"],
        keys: Float[Tensor, "b m c h w"],
        values: Float[Tensor, "b m c h w"],
        ages: Float[Tensor, "2 m c"],
    ) -> Float[Tensor, "b c h w"]:
        """Return h = (1 - lambda) A + lambda CrossAttn(A, M), lambda = sigmoid(recall_logit).

        Keys, values and `ages` are the attention's own projections of the bank.
        """
        recall = self.recall_logit.sigmoid()
        recalled = self.attention.attend(aggregate[:, None], keys, values, ages)[:, 0]
        return (1 - recall) * aggregate + recall * recalled


class TemporalMixing(nn.Module):
    """Aggregate one shallow level over the window: a depthwise temporal filter, then 1x1 (equation 15)."""

    def __init__(self, channels: int, length: int) -> None:
        super().__init__()
        # The newest frame passes through at the start; older ones are learnt in.
        weights = torch.zeros(length, channels)
        weights[-1] = 1.0
        self.weights = nn.Parameter(weights)
        self.mix = projection(channels, channels)

    def forward(
        self,
        frames: Float[Tensor, "b n c h w"],
        common: Float[Tensor, "b c h w"] | None,
        weights: Float[Tensor, "n c"],
    ) -> Float[Tensor, "b c h w"]:
        """Return the mixture of n frames, to each of which `common` is added.

        `weights` are this layer's, in the order of the frames.
        """
        mixed = (frames * weights[:, :, None, None]).sum(1)
        if common is not None:
            mixed = mixed + common * weights.sum(0)[:, None, None]
        return self.mix(mixed)
