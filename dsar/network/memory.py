"""The state stream: a bank of hidden states, read by cross-attention and updated at every step."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from dsar.network.state import push
from dsar.network.temporal import TemporalAttention


class MemoryBank(nn.Module):
    """Blends the window's aggregate A with what it retrieves from the bank M, the last m hidden states."""

    def __init__(self, channels: int, heads: int, length: int, memory_weight: float) -> None:
        """`memory_weight` is lambda at the start."""
        super().__init__()
        self.attention = TemporalAttention(channels, heads, length)
        self.memory_logit = nn.Parameter(torch.tensor(memory_weight).logit())

    def retrieve(
        self,
        aggregate: Float[Tensor, "b c h w"],
        key_values: Float[Tensor, "b m h w d"],
        position_bias: Float[Tensor, "m d"],
    ) -> Float[Tensor, "b c h w"]:
        """Return h* = CrossAttn(A, M) (paper equation 12); the bank as projected by `attention`."""
        return self.attention.attend(aggregate[:, None], key_values, position_bias)[:, 0]

    def forward(
        self,
        aggregate: Float[Tensor, "b c h w"],
        key_values: Float[Tensor, "b m h w d"],
        position_bias: Float[Tensor, "m d"],
    ) -> Float[Tensor, "b c h w"]:
        """Return h = (1 - lambda) A + lambda h*, lambda = sigmoid(memory_logit) (paper equation 13)."""
        retrieved = self.retrieve(aggregate, key_values, position_bias)
        return aggregate.lerp(retrieved, self.memory_logit.sigmoid())

    def first_entry(
        self, aggregate: Float[Tensor, "b c h w"], features: Float[Tensor, "b c h w"]
    ) -> Float[Tensor, "b c h w"]:
        """Return what fills the bank at the first step, before there is a hidden state: the aggregate.

        `features` are the frame's own at the coarsest level, before any attention.
        """
        return aggregate

    def entry(
        self, hidden: Float[Tensor, "b c h w"], features: Float[Tensor, "b c h w"]
    ) -> Float[Tensor, "b c h w"]:
        """Return what a step leaves to the bank: its hidden state."""
        return hidden

    def update(
        self,
        memory: Float[Tensor, "b m c h w"],
        entry: Float[Tensor, "b c h w"],
        fresh: Bool[Tensor, " b"],
    ) -> Float[Tensor, "b m c h w"]:
        """Return the next step's bank: the oldest entry goes, the newest comes (paper equation 14).

        Of rollouts that have only begun all entries are the newest.
        """
        return push(memory, entry, fresh)
