"""Motion-adaptive temporal aggregation (paper section 3.4, geometric stream).

Frames come oldest first, or in any other order together with their `positions`: entry i of the tensor is the
frame at position positions[i] in time, 0 the oldest, n - 1 the newest.
"""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn.functional import linear

from dsar.network.layers import ConvBlock, activate, channels_last, conv, per_pixel, projection


class MotionEmbedding(nn.Module):
    """Phi_m: embed the motion magnitude V into feature space, m = Phi_m(V) (paper equation 7)."""

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
    """Multi-head attention of frames to frames, at each pixel by itself.

    A learnt embedding of a frame's position in time is added to it. Keys and values are linear, so a frame is
    projected once, without the embedding, and the position's share is added where it is attended to.
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
        """Return K and V of frames side by side, without the positions' share (paper equation 9).

        Queries are projected where they attend.
        """
        return linear(frames.movedim(2, -1), *self._key_value_weights())

    def position_bias(self, positions: Int64[Tensor, "*p n"] | None = None) -> Float[Tensor, "*p n d"]:
        """Return what their positions add to the keys and values of frames; None: they are in order."""
        embedding = self.position_embedding if positions is None else self.position_embedding[positions]
        return linear(embedding, self._key_value_weights()[0])

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
        """Return the attention's row of each query, softmax(Q K^T / sqrt(d) + M) V (paper equation 11).

        `key_values` and `position_bias` are `project_keys_values` and `position_bias` of the frames.
        With `offset_features` it is as if they had been added to every frame before. Entries of
        `future_mask` are hidden from a query.
        """
        key_value_bias = position_bias[:, None, None]
        if offset_features is not None:
            offset_bias = linear(offset_features.movedim(1, -1), self._key_value_weights()[0])
            key_value_bias = key_value_bias + offset_bias[:, None]
        b, n, h, w, _ = key_values.shape
        keys, values = (key_values + key_value_bias).view(b, 1, n, h, w, 2, self.heads, -1).unbind(-3)
        projected = per_pixel(self.query, queries.movedim(2, -1))
        projected = projected.view(b, -1, 1, h, w, self.heads, keys.shape[-1])
        scores = (projected * keys).sum(-1, keepdim=True)
        if future_mask is not None:
            scores = scores.masked_fill(future_mask[:, :, None, None, None, None], -torch.inf)
        mixed = (scores.softmax(2) * values).sum(2)
        return per_pixel(self.out, mixed.flatten(-2)).movedim(-1, 2)


class TemporalAggregation(nn.Module):
    """Phi_agg: a shallow level of the window by a depthwise temporal filter, then 1x1 (paper equation 15)."""

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
        """Return the mixture of n frames, to each of which `offset_features` are added.

        `weights` are this layer's, in the order of the frames.
        """
        mixed = (frames.movedim(2, -1) * weights[:, None, None]).sum(1)
        if offset_features is not None:
            mixed = mixed + offset_features.movedim(1, -1) * weights.sum(0)
        return per_pixel(self.mix, mixed).movedim(-1, 1)
