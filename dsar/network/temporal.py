"""Motion-adaptive temporal aggregation and the memory bank (paper section 3.3 and 3.4)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dsar.network.layers import ConvBlock, conv, projection


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
    """Multi-head attention of one query frame over a sequence of frames, at each pixel by itself.

    The paper masks an n x n self-attention causally and reads its last row (equations 9-11); the
    last row sees every frame, so a single query is the same function at 1/n of the cost.
    """

    def __init__(self, channels: int, heads: int, length: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = projection(channels, channels)
        self.key = projection(channels, channels)
        self.value = projection(channels, channels)
        self.out = projection(channels, channels)
        self.age = nn.Parameter(0.02 * torch.randn(length, channels))

    def forward(
        self, query: Float[Tensor, "b c h w"], frames: Float[Tensor, "b n c h w"]
    ) -> Float[Tensor, "b c h w"]:
        """Return the attended mixture of frames, oldest first, for the query frame.

        A learnt embedding of each frame's age is added before the keys and values are formed.
        """
        b, n, c, h, w = frames.shape
        tokens = (frames + self.age[:, :, None, None]).flatten(0, 1)
        keys = self.key(tokens).reshape(b, n, self.heads, c // self.heads, h, w)
        values = self.value(tokens).reshape(b, n, self.heads, c // self.heads, h, w)
        queries = self.query(query).reshape(b, 1, self.heads, c // self.heads, h, w)
        scores = (queries * keys).sum(3, keepdim=True) * (c // self.heads) ** -0.5
        return self.out((scores.softmax(1) * values).sum(1).reshape(b, c, h, w))


class MemoryBank(nn.Module):
    """Mix the aggregate of the window with what the bank recalls (paper equations 12-13)."""

    def __init__(self, channels: int, heads: int, length: int, recall: float) -> None:
        super().__init__()
        self.attention = TemporalAttention(channels, heads, length)
        self.recall_logit = nn.Parameter(torch.tensor(recall).logit())

    def forward(
        self, aggregate: Float[Tensor, "b c h w"], memory: Float[Tensor, "b m c h w"]
    ) -> Float[Tensor, "b c h w"]:
        """Return h = (1 - lambda) A + lambda CrossAttn(A, M), lambda = sigmoid(recall_logit)."""
        recall = self.recall_logit.sigmoid()
        return (1 - recall) * aggregate + recall * self.attention(aggregate, memory)


class TemporalMixing(nn.Module):
    """Aggregate one shallow level over the window: a depthwise temporal filter, then 1x1 (equation 15)."""

    def __init__(self, channels: int, length: int) -> None:
        super().__init__()
        # The newest frame passes through at the start; older ones are learnt in.
        weights = torch.zeros(length, channels)
        weights[-1] = 1.0
        self.weights = nn.Parameter(weights)
        self.mix = projection(channels, channels)

    def forward(self, frames: Float[Tensor, "b n c h w"]) -> Float[Tensor, "b c h w"]:
        """Return the mixture of n frames, oldest first."""
        return self.mix((frames * self.weights[:, :, None, None]).sum(1))
