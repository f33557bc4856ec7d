"""What the network remembers between frames: the paper's two streams, and the sliding window."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Stream = Literal["geometric", "state"]
STREAMS: tuple[Stream, ...] = ("geometric", "state")
"""Both: previous offsets fed back, and the memory bank."""


@dataclass(frozen=True)
class NetworkState:
    """The two streams and the sliding window of a batch of independent rollouts.

    While `fresh` is set `offsets` are zero and all others meaningless: the first step fills the window with
    copies of its own frame, looks into a bank of copies of its aggregate, and leaves one of copies of h_1.
    In memory the channels of window, motion and bank are last, as convolutions and attention like it.
    """

    fresh: Bool[Tensor, " b"]
    """Rollouts that have not seen a frame yet."""
    window: tuple[Float[Tensor, "b n ..."], ...]
    """What the last n frames left behind, oldest first: features by level, or input maps (see `encoder`)."""
    motion: Float[Tensor, "b _ c hL wL"]
    """Embedded motion magnitudes m of the last n frames at the coarsest level, oldest first."""
    offsets: Float[Tensor, "b k 3 h w"]
    """Geometric stream: the offset maps of the last k frames (the paper: 1), metres, oldest first."""
    memory: Float[Tensor, "b m c hL wL"]
    """State stream: the bank of the last m hidden states h, oldest first."""

    def map(self, function: Callable[[Tensor], Tensor]) -> "NetworkState":
        """Apply a function to every tensor."""
        values = {
            f.name: tuple(map(function, value)) if isinstance(value, tuple) else function(value)
            for f in dataclasses.fields(self)
            for value in (getattr(self, f.name),)
        }
        return dataclasses.replace(self, **values)

    def detach(self) -> "NetworkState":
        """Cut the state from the autograd graph (the border of truncated back-propagation)."""
        return self.map(Tensor.detach)

    def restart(self, rollouts: Bool[Tensor, " b"]) -> "NetworkState":
        """Mark some rollouts as fresh; the others go on."""
        return dataclasses.replace(
            self,
            fresh=self.fresh | rollouts,
            offsets=torch.where(rollouts[:, None, None, None, None], 0.0, self.offsets),
        )


def fill_where_fresh(
    fresh: Bool[Tensor, " b"], newest: Float[Tensor, "b *s"], entries: Float[Tensor, "b n *s"]
) -> Float[Tensor, "b n *s"]:
    """Return the entries, or copies of the newest one for rollouts that have no history yet."""
    # On a GPU the host would have to wait to know.
    if fresh.device.type == "cpu" and not fresh.any():
        return entries
    mask = fresh.reshape(-1, *[1] * (entries.ndim - 1))
    return torch.where(mask, newest[:, None], entries)


def push(
    entries: Float[Tensor, "b n c h w"], newest: Float[Tensor, "b c h w"], fresh: Bool[Tensor, " b"]
) -> Float[Tensor, "b n c h w"]:
    """Drop the oldest entry and append the newest; without history it fills all places."""
    newest = newest.movedim(1, -1)
    history = fill_where_fresh(fresh, newest, entries.movedim(2, -1))
    return torch.cat([history[:, 1:], newest[:, None]], 1).movedim(-1, 2)
