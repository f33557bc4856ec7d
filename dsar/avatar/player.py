"""A player: an avatar driven through a motion frame by frame, forwards and to any frame.

Rendering, exports and viewers all play avatars by it. A frame follows from all before it; so that going back
does not begin anew, the player keeps snapshots of the network's memory on its way.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.driving import DrivingSignal
from dsar.avatar.guards import LIMITS, Guard, GuardCounts, fired
from dsar.avatar.watchdog import Watchdog, WatchdogState
from dsar.network import STREAMS, NetworkOutput, Stream
from dsar.network.session import InferenceSession, SessionSnapshot
from dsar.types import Gaussians, GuardedFrame

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
    own: NetworkOutput
    """The same without the motion prior, if the avatar has one."""
    guard_counts: GuardCounts
    """What each guard limited."""
    guarded: GuardedFrame | None = None
    """What guards found amiss, and did; None where nothing was."""


@dataclass(frozen=True)
class PlayedFrame:
    """A frame as it is shown."""

    number: int
    """Frame of the driving signal, counted from 0."""
    gaussians: Gaussians
    """Posed."""
    guard_counts: GuardCounts
    """What each guard limited."""
    guarded: GuardedFrame | None = None
    """What guards found amiss, and did; None where nothing was."""

    @property
    def fired(self) -> frozenset[Guard]:
        """The guards that limited anything."""
        return fired(self.guard_counts)


class Player:
    """Plays one rollout of an avatar, as it was when the player was made.

    Frames are the same to the last bit, whichever were played before them.
    """

    def __init__(
        self,
        avatar: Avatar,
        signal: DrivingSignal,
        *,
        streams: Collection[Stream] = STREAMS,
        guarded: bool = True,
    ) -> None:
        """Begin before the first frame of a signal at the avatar's rate.

        Without one of the `streams` the network runs as if it had none of its memory. Where the avatar has
        limits for it (`Avatar.guard_limits`) and the player is guarded, a watchdog replaces frames that would
        break.
        """
        self.avatar, self.signal = avatar, signal
        self._session = InferenceSession(avatar.network, streams)
        self._breaks = {Guard.JUMP: frozenset(signal.jumps), Guard.CUT: frozenset(signal.cuts)}
        self._jumped, self._cut = (_marks(signal, frames) for frames in (signal.jumps, signal.cuts))
        self._next, self._distance = 0, SNAPSHOT_FRAMES
        self._fresh = self._session.snapshot()
        limits = avatar.guard_limits if guarded else None
        self._watchdog = None if limits is None else Watchdog(limits, avatar.fps, signal.windows.device)
        self._snapshots: dict[int, _Snapshot] = {0: self._snapshot()}

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
            session, watchdog = self._snapshots[known]
            self._session.restore(session)
            if self._watchdog is not None and watchdog is not None:
                self._watchdog.state = watchdog
            self._next = known
        while self._next < frame:
            self.forward_frame()

    def step(self) -> PlayedFrame:
        """Play the next frame."""
        frame = self.forward_frame()
        with torch.no_grad():
            gaussians = self.avatar.gaussians(frame.motion_window, frame.output)[0]
        return PlayedFrame(frame.number, gaussians, frame.guard_counts, frame.guarded)

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
        cut = number in self._breaks[Guard.CUT]
        if cut:
            self._session.restore(self._fresh)
        window = self.signal.windows[number : number + 1]
        cloth = self.signal.cloth_at(range(number, number + 1))
        inputs = avatar.input_maps(window, avatar.fps, cloth)
        maps, magnitude = avatar.standardize(inputs)
        own = self._session.step(maps, magnitude)
        guarded = None
        if self._watchdog is not None:
            if cut:
                self._watchdog.forget()
            pose_only = _PoseOnly(avatar, self._session, self._fresh, maps, magnitude)
            own, guarded = self._watchdog.watch(maps, own, pose_only)
            guarded = _with_breaks(
                guarded, [guard for guard, where in self._breaks.items() if number in where]
            )
        output = avatar.add_prior(own, cloth)
        near = LIMITS.offset * avatar.model.offset_limit
        counts = {
            **inputs.guard_counts,
            Guard.OFFSET: (output.offset.abs() > near).sum((1, 2, 3)),
            Guard.JUMP: self._jumped[number : number + 1],
            Guard.CUT: self._cut[number : number + 1],
        }
        self._next += 1
        return NetworkFrame(number, window, output, own, counts, guarded)

    def _snapshot(self) -> "_Snapshot":
        return self._session.snapshot(), None if self._watchdog is None else self._watchdog.state

    def _keep_snapshot(self, number: int) -> None:
        self._snapshots[number] = self._snapshot()
        if len(self._snapshots) > MAX_SNAPSHOTS:
            self._distance *= 2
            self._snapshots = {n: s for n, s in self._snapshots.items() if n % self._distance == 0}


_Snapshot = tuple[SessionSnapshot, WatchdogState | None]


@dataclass(frozen=True)
class _PoseOnly:
    """Makes one frame of its pose alone, whatever the session remembers (`watchdog.PoseOnly`)."""

    avatar: Avatar
    session: InferenceSession
    fresh: SessionSnapshot
    maps: Float[Tensor, "1 c h w"]
    magnitude: Float[Tensor, "1 1 h w"]

    def restart(self) -> NetworkOutput:
        """Drop the session's memory and return what the network makes of this frame as a first one."""
        self.session.restore(self.fresh)
        return self.session.step(self.maps, self.magnitude)

    def template(self) -> NetworkOutput:
        """Drop the session's memory and return the output of a network that says nothing.

        What is added to it is the motion prior alone, where there is one: it needs no network.
        """
        self.session.restore(self.fresh)
        points = self.maps.new_zeros(1, len(self.avatar.garment_control_points()), 3)
        return self.avatar.offset_garment(points)


def _marks(signal: DrivingSignal, frames: Sequence[int]) -> Int64[Tensor, " f"]:
    """Return 1 in some frames of a signal, 0 in the others."""
    marks = signal.windows.new_zeros(len(signal), dtype=torch.int64)
    marks[list(frames)] = 1
    return marks


def _with_breaks(found: GuardedFrame | None, breaks: Collection[Guard]) -> GuardedFrame | None:
    """Return what was found in a frame, and the breaks in its motion."""
    if not breaks:
        return found
    exceeded = {str(guard): math.inf for guard in breaks}
    return GuardedFrame(
        {**exceeded, **({} if found is None else found.exceeded)}, 0.0 if found is None else found.held
    )
