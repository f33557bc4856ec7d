"""Motion-adaptive temporal aggregation and the memory bank (paper sections 3.3 and 3.4).

Frames come oldest first, or in any other `order`: then entry i is the frame of age order[i], 0 the oldest,
n - 1 the newest.
"""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn.functional import linear

from dsar.network.layers import ConvBlock, activate, channels_last, conv, per_pixel, projection


class MotionEmbedding(nn.Module):
    """Embed the motion magnitude V into feature space (paper equation 7)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.block = ConvBlock(1, channels // 2)
        self.out = conv(channels // 2, channels)

    def forward(self, magnitude: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b c h w"]:
        """Return the embedding of a magnitude map in units of its standard deviation."""
        hidden = activate(self.block.first(magnitude))
        # A single channel does not tell convolutions how it is laid out.
        return self.out(activate(self.block.second(channels_last(hidden))))


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
        self.position_embedding = nn.Parameter(0.02 * torch.randn(length, channels))
        self._frozen: tuple[Tensor, Tensor] | None = None

    def freeze(self) -> None:
        """Join the weights of keys and values once and for all: they no longer change."""
        self._frozen = self._key_value_weights()

    def project_keys_values(self, frames: Float[Tensor, "b n c h w"]) -> Float[Tensor, "b n h w _"]:
        """Return keys and values of frames side by side, without their ages."""
        return linear(frames.movedim(2, -1), *self._key_value_weights())

    def position_bias(self, order: Int64[Tensor, "*p n"] | None = None) -> Float[Tensor, "*p n d"]:
        """Return what their ages add to the keys and values of frames."""
        return linear(
            self.position_embedding if order is None else self.position_embedding[order],
            self._key_value_weights()[0],
        )

    def _key_value_weights(self) -> tuple[Float[Tensor, "d c"], Float[Tensor, " d"]]:
        """Return the weights and the bias of both, one above the other; keys have the scores' scale."""
        if self._frozen is not None:
            return self._frozen
        key, value, scale = self.key, self.value, (self.key.out_channels // self.heads) ** -0.5
        assert key.bias is not None
        assert value.bias is not None
        weight = torch.cat([scale * key.weight, value.weight])[:, :, 0, 0]
        return weight, torch.cat([scale * key.bias, value.bias])

    def attend(
        self,
        queries: Float[Tensor, "b q c h w"],
        key_values: Float[Tensor, "b n h w d"],
        position_bias: Float[Tensor, "n d"],
        *,
        offset_features: Float[Tensor, "b c h w"] | None = None,
        future_mask: Bool[Tensor, "q n"] | None = None,
    ) -> Float[Tensor, "b q c h w"]:
        """Return what each query finds among frames given by `project_keys_values` and `position_bias`.

        `offset_features` were to be added to every frame before they were projected. Entries of
        `future_mask` are hidden from a query.
        """
        key_value_bias = position_bias[:, None, None]
        if offset_features is not None:
            key_value_bias = (
                key_value_bias + linear(offset_features.movedim(1, -1), self._key_value_weights()[0])[:, None]
            )
        b, n, h, w, _ = key_values.shape
        keys, values = (key_values + key_value_bias).view(b, 1, n, h, w, 2, self.heads, -1).unbind(-3)
        projected_queries = per_pixel(self.query, queries.movedim(2, -1)).view(
            b, -1, 1, h, w, self.heads, keys.shape[-1]
        )
        scores = (projected_queries * keys).sum(-1, keepdim=True)
        if future_mask is not None:
            scores = scores.masked_fill(future_mask[:, :, None, None, None, None], -torch.inf)
        mixed = (scores.softmax(2) * values).sum(2)
        return per_pixel(self.out, mixed.flatten(-2)).movedim(-1, 2)


class MemoryBank(nn.Module):
    """Mix the aggregate of the window with what the bank recalls (paper equations 12-13)."""

    def __init__(self, channels: int, heads: int, length: int, memory_weight: float) -> None:
        super().__init__()
        self.attention = TemporalAttention(channels, heads, length)
        self.memory_logit = nn.Parameter(torch.tensor(memory_weight).logit())

    def forward(
        self,
        aggregate: Float[Tensor, "b c h w"],
        key_values: Float[Tensor, "b m h w d"],
        position_bias: Float[Tensor, "m d"],
    ) -> Float[Tensor, "b c h w"]:
        """Return h = (1 - lambda) A + lambda CrossAttn(A, M), lambda = sigmoid(memory_logit).

        `key_values` and `position_bias` are the attention's own projections of the bank.
        """
        recalled = self.attention.attend(aggregate[:, None], key_values, position_bias)[:, 0]
        return aggregate.lerp(recalled, self.memory_logit.sigmoid())


class TemporalAggregation(nn.Module):
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
        offset_features: Float[Tensor, "b c h w"] | None,
        weights: Float[Tensor, "n c"],
    ) -> Float[Tensor, "b c h w"]:
        """Return the mixture of n frames, to each of which `common` is added.

        `weights` are this layer's, in the order of the frames.
        """
        mixed = (frames.movedim(2, -1) * weights[:, None, None]).sum(1)
        if offset_features is not None:
            mixed = mixed + offset_features.movedim(1, -1) * weights.sum(0)
        return per_pixel(self.mix, mixed).movedim(-1, 1)
