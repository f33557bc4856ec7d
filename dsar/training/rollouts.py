"""The rollouts that a worker trains on: which frame of which sequence each one sees next."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor


@dataclass
class RolloutCursor:
    """Where one rollout stands."""

    sequence: str
    """Name of the training sequence."""
    frame: int
    """Frame it will see next."""
    age: int
    """Frames it has seen since it was fresh."""
    mirrored: bool = False
    """Whether it sees the mirrored motion."""


class RolloutBatch:
    """The cursors of a fixed number of rollouts over clips of frames [start, stop) of named sequences."""

    def __init__(self, clips: Mapping[str, range], count: int, mirrored_fraction: float = 0.0) -> None:
        self.clips, self.mirrored_fraction = dict(clips), mirrored_fraction
        self.cursors: list[RolloutCursor | None] = [None] * count

    def next_frames(
        self, generators: Sequence[np.random.Generator], max_rollout_frames: int
    ) -> tuple[list[RolloutCursor], list[bool]]:
        """Return where each rollout stands, and which of them start afresh with this frame.

        Each has a generator of its own.

        A rollout restarts at the end of its clip or after `max_rollout_frames`: in the middle of a clip
        while those are few, at a clip's first frame (where cloth is at rest) once they are not. The first
        start of all is anywhere, or rollouts of whole clips would march in step.
        """
        fresh = []
        for index, cursor in enumerate(self.cursors):
            ended = (
                cursor is None
                or cursor.frame >= self.clips[cursor.sequence].stop
                or cursor.age >= max_rollout_frames
            )
            if ended:
                self.cursors[index] = self._restart(
                    generators[index], max_rollout_frames, anywhere=cursor is None
                )
            fresh.append(ended)
        return [cursor for cursor in self.cursors if cursor is not None], fresh

    def advance(self) -> None:
        """Move every rollout one frame on."""
        for cursor in self.cursors:
            if cursor is not None:
                cursor.frame, cursor.age = cursor.frame + 1, cursor.age + 1

    def state_dict(self) -> dict[str, Int64[Tensor, "k 4"]]:
        """Return the cursors of each sequence: index of the rollout, frame, age, mirrored (0 or 1)."""
        rows: defaultdict[str, list[list[int]]] = defaultdict(list)
        for index, cursor in enumerate(self.cursors):
            if cursor is not None:
                rows[cursor.sequence].append([index, cursor.frame, cursor.age, int(cursor.mirrored)])
        return {sequence: torch.tensor(cursors) for sequence, cursors in rows.items()}

    def load_state_dict(self, tensors: Mapping[str, Int64[Tensor, "k 4"]]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            KeyError: a sequence is none that is trained on.
            IndexError: there are fewer rollouts.
        """
        self.cursors[:] = [None] * len(self.cursors)
        for sequence, rows in tensors.items():
            if sequence not in self.clips:
                raise KeyError(sequence)
            for index, frame, age, mirrored in rows.tolist():
                self.cursors[index] = RolloutCursor(sequence, frame, age, bool(mirrored))

    def _restart(self, rng: np.random.Generator, max_rollout_frames: int, *, anywhere: bool) -> RolloutCursor:
        names = list(self.clips)
        lengths = np.array([len(self.clips[name]) for name in names], float)
        name = names[rng.choice(len(names), p=lengths / lengths.sum())]
        clip = self.clips[name]
        latest = clip.stop - (1 if anywhere else max_rollout_frames)
        start = int(rng.integers(clip.start, latest + 1)) if latest > clip.start else clip.start
        return RolloutCursor(name, start, 0, bool(rng.random() < self.mirrored_fraction))
