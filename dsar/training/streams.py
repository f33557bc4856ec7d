"""The rollouts that a worker advances: which frame of which sequence each one sees next."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass
class Place:
    """One rollout's place."""

    sequence: str
    """Name of the training sequence."""
    frame: int
    """Frame it will see next."""
    age: int
    """Frames it has seen since it was fresh."""
    mirrored: bool = False
    """Whether it sees the mirrored motion."""


class Streams:
    """A fixed number of rollouts over clips of frames [start, stop) of named sequences."""

    def __init__(self, clips: Mapping[str, range], count: int, mirrored: float = 0.0) -> None:
        self.clips, self.mirrored = dict(clips), mirrored
        self.streams: list[Place | None] = [None] * count

    def next_frames(self, rng: np.random.Generator, horizon: int) -> tuple[list[Place], list[bool]]:
        """Return where each rollout stands, and which of them start afresh with this frame.

        A rollout restarts at the end of its clip or after `horizon` frames: in the middle of a clip
        while the horizon is short, at a clip's first frame (where cloth is at rest) once it is not. The
        first start of all is anywhere, or rollouts of whole clips would march in step.
        """
        fresh = []
        for index, stream in enumerate(self.streams):
            over = stream is None or stream.frame >= self.clips[stream.sequence].stop or stream.age >= horizon
            if over:
                self.streams[index] = self._restart(rng, horizon, anywhere=stream is None)
            fresh.append(over)
        return [stream for stream in self.streams if stream is not None], fresh

    def advance(self) -> None:
        """Move every rollout one frame on."""
        for stream in self.streams:
            if stream is not None:
                stream.frame, stream.age = stream.frame + 1, stream.age + 1

    def _restart(self, rng: np.random.Generator, horizon: int, *, anywhere: bool) -> Place:
        names = list(self.clips)
        lengths = np.array([len(self.clips[name]) for name in names], float)
        name = names[rng.choice(len(names), p=lengths / lengths.sum())]
        clip = self.clips[name]
        latest = clip.stop - (1 if anywhere else horizon)
        start = int(rng.integers(clip.start, latest + 1)) if latest > clip.start else clip.start
        return Place(name, start, 0, bool(rng.random() < self.mirrored))
