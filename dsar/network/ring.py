"""Rings of the last n entries, overwritten in place, so that nothing moves as frames grow older."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor


class RingIndex:
    """Says which entry of rings of n entries is the newest.

    It is a tensor, so that a recorded step moves it on.
    """

    def __init__(self, length: int, device: torch.device) -> None:
        self.length = length
        self.newest = torch.full((1,), length - 1, dtype=torch.int64, device=device)

    def advance(self) -> None:
        """Go on to the entry that is overwritten next, the oldest."""
        self.newest.add_(1).remainder_(self.length)

    def positions_by_index(self) -> Int64[Tensor, "n n"]:
        """Return all entries' positions in time, 0 the oldest, for each place that the newest can have."""
        entries = torch.arange(self.length, device=self.newest.device)
        return (entries - entries[:, None] - 1) % self.length


class RingBuffer:
    """What the last n frames left, as entries [b n *s]; the first frame's fills it."""

    def __init__(self, index: RingIndex) -> None:
        self._index = index
        self._storage: Tensor | None = None
        self._empty = True

    @property
    def entries(self) -> Tensor | None:
        """All entries, in the ring's order; None before the first."""
        return None if self._empty else self._storage

    def push(self, newest: Float[Tensor, "b *s"]) -> Float[Tensor, "b n *s"]:
        """Write the newest entry; return all."""
        if self._storage is None:
            self._storage = newest[:, None].repeat(1, self._index.length, *[1] * (newest.ndim - 1))
        elif self._empty:
            self._storage.copy_(newest[:, None].expand_as(self._storage))
        else:
            self._storage.index_copy_(1, self._index.newest, newest[:, None])
        self._empty = False
        return self._storage

    def push_map(self, newest: Float[Tensor, "b c h w"]) -> Float[Tensor, "b n c h w"]:
        """Do the same with maps, which lie in memory with their channels last."""
        return self.push(newest.movedim(1, -1)).movedim(-1, 2)

    def snapshot(self) -> Tensor | None:
        """Return a copy of the entries; None before the first."""
        return None if self.entries is None else self.entries.clone()

    def restore(self, entries: Tensor | None) -> None:
        """Take entries as they were; where there is storage they are copied into it."""
        self._empty = entries is None
        if entries is not None and self._storage is not None:
            self._storage.copy_(entries)
        elif entries is not None:
            self._storage = entries.to(self._index.newest.device, copy=True)
