"""Frames of a rollout with those beside them: what motion vectors and open shutters need."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import torch

from dsar.types import Gaussians, GaussianSequence


@dataclass(frozen=True)
class FrameTriplet:
    """A frame's Gaussians, and those of the frames beside it where the motion has them."""

    frame: int
    """Frame number."""
    now: Gaussians
    before: Gaussians | None = None
    after: Gaussians | None = None

    def at(self, offset: float) -> Gaussians:
        """Return the Gaussians `offset` frames (-1 to 1) from the frame.

        Positions, scales, opacities and colours change linearly between frames, rotations along the shorter
        arc. Beyond the first and the last frame of a motion everything stands still.
        """
        other = self.after if offset > 0 else self.before
        if offset == 0 or other is None:
            return self.now
        return _blend(self.now, other, abs(offset))


def add_neighbours(frames: Sequence[int], first: int, last: int) -> list[int]:
    """Return the frames and those beside them, within a motion from `first` to `last`, ascending."""
    every = {frame + step for frame in frames for step in (-1, 0, 1)}
    return sorted(frame for frame in every if first <= frame <= last)


def iterate_triplets(
    sequence: GaussianSequence, frames: Collection[int], *, neighbours: bool = True
) -> Iterator[FrameTriplet]:
    """Yield the wanted frames, each with those of the sequence that come right before and after it.

    A frame is yielded when the one after it has been made; without neighbours, when it has been made itself.
    """
    if not neighbours:
        yield from (FrameTriplet(number, each.detach()) for number, each in sequence if number in frames)
        return
    kept: list[tuple[int, Gaussians]] = []
    for number, gaussians in sequence:
        kept = [*kept[-2:], (number, gaussians.detach())]
        if len(kept) > 1 and kept[-2][0] in frames:
            yield _join(kept, kept[-2][0])
    if kept and kept[-1][0] in frames:
        yield _join(kept, kept[-1][0])


def _join(kept: Sequence[tuple[int, Gaussians]], frame: int) -> FrameTriplet:
    """Return the triplet of a frame among some kept ones."""
    found = dict(kept)
    return FrameTriplet(frame, found[frame], found.get(frame - 1), found.get(frame + 1))


def _blend(first: Gaussians, second: Gaussians, share: float) -> Gaussians:
    """Return the Gaussians `share` of the way from the first to the second."""
    # q and -q are one rotation: the sum takes the shorter arc where their product is positive.
    opposed = (first.rotations * second.rotations).sum(-1, keepdim=True) < 0
    turned = torch.lerp(first.rotations, torch.where(opposed, -second.rotations, second.rotations), share)
    return Gaussians(
        means=torch.lerp(first.means, second.means, share),
        rotations=torch.nn.functional.normalize(turned, dim=-1),
        scales=torch.lerp(first.scales, second.scales, share),
        opacities=torch.lerp(first.opacities, second.opacities, share),
        harmonics=torch.lerp(first.harmonics, second.harmonics, share),
    )
