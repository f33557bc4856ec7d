"""A player: an avatar driven through a motion frame by frame, forwards and to any frame.

Rendering, exports and viewers all play avatars by it. A frame follows from all before it; so that going back
does not begin anew, the player keeps snapshots of the network's memory on its way.
"""

from collections.abc import Collection
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.driving import DrivingSignal
from dsar.avatar.guards import LIMITS, Guard, GuardCounts, fired
from dsar.network import STREAMS, NetworkOutput, Stream
from dsar.network.session import InferenceSession, SessionSnapshot
from dsar.types import Gaussians

SNAPSHOT_FRAMES = 30
"""Frames between snapshots of a short motion."""
MAX_SNAPSHOTS = 32
"""Snapshots that are kept: when there are more, every other one is dropped, and their distance doubles."""


@dataclass(frozen=True)
class NetworkFrame:
    """A frame before it is posed."""

    number: int
    """Frame of the driving signal, counted from 0."""
    motion_window: Float[Tensor, "1 t j 4 4"]
    """What drives the frame."""
    output: NetworkOutput
    """What the network made of it; on a GPU it lasts until the next frame."""
    guard_counts: GuardCounts
    """What each guard limited."""


@dataclass(frozen=True)
class PlayedFrame:
    """A frame as it is shown."""

    number: int
    """Frame of the driving signal, counted from 0."""
    gaussians: Gaussians
    """Posed."""
    guard_counts: GuardCounts
    """What each guard limited."""

    @property
    def fired(self) -> frozenset[Guard]:
        """The guards that limited anything."""
        return fired(self.guard_counts)


class Player:
    """Plays one rollout of an avatar, as it was when the player was made.

    Frames are the same to the last bit, whichever were played before them.
    """

    def __init__(
        self, avatar: Avatar, signal: DrivingSignal, *, streams: Collection[Stream] = STREAMS
    ) -> None:
        """Begin before the first frame of a signal at the avatar's rate.

        Without one of the `streams` the network runs as if it had none of its memory.
        """
        self.avatar, self.signal = avatar, signal
        self._session = InferenceSession(avatar.network, streams)
        jumped = signal.windows.new_zeros(len(signal), dtype=torch.int64)
        jumped[list(signal.jumps)] = 1
        self._jumped, self._next, self._distance = jumped, 0, SNAPSHOT_FRAMES
        self._snapshots: dict[int, SessionSnapshot] = {0: self._session.snapshot()}

    @property
    def next_frame(self) -> int:
        """The frame that is played next."""
        return self._next

    def seek(self, frame: int) -> None:
        """Go to a frame, so that it is played next.

        From the nearest frame before it whose memory is known, the network takes the steps in between.

        Raises:
            IndexError: the signal has no such frame.
        """
        if not 0 <= frame < len(self.signal):
            raise IndexError(f"frame {frame} of {self.signal.name}, which has {len(self.signal)}")
        known = max(number for number in self._snapshots if number <= frame)
        if not known <= self._next <= frame:
            self._session.restore(self._snapshots[known])
            self._next = known
        while self._next < frame:
            self.forward_frame()

    def step(self) -> PlayedFrame:
        """Play the next frame."""
        frame = self.forward_frame()
        with torch.no_grad():
            gaussians = self.avatar.gaussians(frame.motion_window, frame.output)[0]
        return PlayedFrame(frame.number, gaussians, frame.guard_counts)

    @torch.no_grad()
    def forward_frame(self) -> NetworkFrame:
        """Play the next frame without posing its Gaussians.

        Raises:
            IndexError: the signal is at its end.
        """
        number, avatar = self._next, self.avatar
        if number == len(self.signal):
            raise IndexError(f"{self.signal.name} ends after {number} frames")
        if number % self._distance == 0 and number not in self._snapshots:
            self._keep_snapshot(number)
        motion_window = self.signal.windows[number : number + 1]
        cloth = self.signal.cloth_at(range(number, number + 1))
        inputs = avatar.input_maps(motion_window, avatar.fps, cloth)
        output = avatar.add_prior(self._session.step(*avatar.standardize(inputs)), cloth)
        near = LIMITS.offset * avatar.model.offset_limit
        counts = {
            **inputs.guard_counts,
            Guard.OFFSET: (output.offset.abs() > near).sum((1, 2, 3)),
            Guard.JUMP: self._jumped[number : number + 1],
        }
        self._next += 1
        return NetworkFrame(number, motion_window, output, counts)

    def _keep_snapshot(self, number: int) -> None:
        self._snapshots[number] = self._session.snapshot()
        if len(self._snapshots) > MAX_SNAPSHOTS:
            self._distance *= 2
            self._snapshots = {n: s for n, s in self._snapshots.items() if n % self._distance == 0}
