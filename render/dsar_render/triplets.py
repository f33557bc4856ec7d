"""Frames of a rollout with those beside them: what motion vectors and open shutters need."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch

from dsar.types import Gaussians, GaussianSequence, GuardedFrame


@dataclass(frozen=True)
class FrameTriplet:
    """A frame's Gaussians, and those of the frames beside it where the motion has them."""

    frame: int
    """Frame number."""
    current: Gaussians
    previous: Gaussians | None = None
    following: Gaussians | None = None
    guarded: GuardedFrame | None = None
    """What guards found in the frame."""

    def interpolate(self, offset: float) -> Gaussians:
        """Return the Gaussians `offset` frames (-1 to 1) from the frame.

        Positions, scales, opacities and colours change linearly between frames, rotations along the shorter
        arc. Beyond the first and the last frame of a motion everything stands still.
        """
        neighbour = self.following if offset > 0 else self.previous
        if offset == 0 or neighbour is None:
            return self.current
        return _lerp(self.current, neighbour, abs(offset))


def add_neighbours(frames: Sequence[int], first: int, last: int) -> list[int]:
    """Return the frames and those beside them, within a motion from `first` to `last`, ascending."""
    neighbours = {frame + step for frame in frames for step in (-1, 0, 1)}
    return sorted(frame for frame in neighbours if first <= frame <= last)


def iterate_triplets(
    sequence: GaussianSequence, frames: Collection[int], *, neighbours: bool = True
) -> Iterator[FrameTriplet]:
    """Yield the wanted frames, each with those of the sequence that come right before and after it.

    A frame is yielded when the one after it has been made; without neighbours, when it has been made itself.
    """
    if not neighbours:
        yield from (
            FrameTriplet(number, gaussians.detach(), guarded=sequence.guarded.get(number))
            for number, gaussians in sequence
            if number in frames
        )
        return
    recent: list[tuple[int, Gaussians]] = []
    for number, gaussians in sequence:
        recent = [*recent[-2:], (number, gaussians.detach())]
        if len(recent) > 1 and recent[-2][0] in frames:
            yield _join(recent, recent[-2][0], sequence.guarded)
    if recent and recent[-1][0] in frames:
        yield _join(recent, recent[-1][0], sequence.guarded)


def _join(
    recent: Sequence[tuple[int, Gaussians]], frame: int, guarded: Mapping[int, GuardedFrame]
) -> FrameTriplet:
    """Return the triplet of a frame among the most recent ones."""
    gaussians = dict(recent)
    beside = gaussians.get(frame - 1), gaussians.get(frame + 1)
    return FrameTriplet(frame, gaussians[frame], *beside, guarded.get(frame))


def _lerp(first: Gaussians, second: Gaussians, fraction: float) -> Gaussians:
    """Return the Gaussians `fraction` of the way from the first to the second."""
    # q and -q are one rotation: the sum takes the shorter arc where their product is positive.
    opposed = (first.rotations * second.rotations).sum(-1, keepdim=True) < 0
    rotations = torch.lerp(
        first.rotations, torch.where(opposed, -second.rotations, second.rotations), fraction
    )
    return Gaussians(
        means=torch.lerp(first.means, second.means, fraction),
        rotations=torch.nn.functional.normalize(rotations, dim=-1),
        scales=torch.lerp(first.scales, second.scales, fraction),
        opacities=torch.lerp(first.opacities, second.opacities, fraction),
        harmonics=torch.lerp(first.harmonics, second.harmonics, fraction),
    )
