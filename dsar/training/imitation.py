"""Imitation: the network learns to follow the registered maps, in long stretches and without rendering.

A rollout begins anywhere in a sequence. While its window fills, the registered maps are fed back in place of
the network's own, so that it sets out in motion; then it is alone, and errors flow back through the stretch.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.avatar import Avatar, contexts
from dsar.avatar.mirror import mirror_offset, mirror_track
from dsar.config import TrainConfig
from dsar.errors import TrainingError
from dsar.training.losses import registered_loss
from dsar.training.segment import Progress

SEGMENT = 28
"""Frames of a rollout."""
STREAMS = 4
"""Rollouts of an update."""
FROM_REST = 0.25
"""Share of the rollouts that begin with their sequence."""
NOISE = 0.01
"""Standard deviation of an error common to a whole map that is fed back, metres."""


@dataclass(frozen=True)
class _Lesson:
    """One sequence as the network sees it, and the maps it should answer with."""

    maps: Float[Tensor, "f c h w"]
    speed: Float[Tensor, "f 1 h w"]
    offset: Float[Tensor, "f 3 h w"]


class Imitation:
    """Turns registered maps into gradients."""

    def __init__(
        self,
        config: TrainConfig,
        avatar: Avatar,
        tracks: Mapping[str, Float[Tensor, "_ j 4 4"]],
        registered: Mapping[str, tuple[range, Float[Tensor, "_ 3 h w"]]],
    ) -> None:
        """Prepare to imitate maps; `registered` gives the frames that have one, and all maps."""
        self.avatar, self.mirrored = avatar, config.schedule.mirrored
        self.frames = {name: frames for name, (frames, _) in registered.items() if len(frames) > 1}
        self.names = list(self.frames)
        self.lengths = np.array([len(self.frames[name]) for name in self.names], float)
        self.lessons = {
            (name, mirrored): self._lesson(tracks[name], registered[name][1], mirrored=mirrored)
            for name in self.names
            for mirrored in (False, True)
        }

    def segment(self, rng: np.random.Generator) -> Progress:
        """Back-propagate the errors of some rollouts."""
        places = [self._draw(rng) for _ in range(STREAMS)]
        state, network, loss = self.avatar.start(STREAMS), self.avatar.network, torch.zeros(())
        warm_up = network.config.window
        for age in range(SEGMENT):
            frames = [min(start + age, self.frames[name].stop - 1) for name, start, _ in places]
            lessons = [self.lessons[name, mirrored] for name, _, mirrored in places]
            if 0 < age <= warm_up:
                taught = [lesson.offset[frame - 1] for lesson, frame in zip(lessons, frames, strict=True)]
                noise = NOISE * torch.from_numpy(rng.standard_normal((STREAMS, 3, 1, 1), np.float32))
                fed = (torch.stack(taught) + noise) * network.occupied
                state = dataclasses.replace(state, offset=fed)
            maps, speed, truth = (
                torch.stack(
                    [getattr(lesson, key)[frame] for lesson, frame in zip(lessons, frames, strict=True)]
                )
                for key in ("maps", "speed", "offset")
            )
            output, state = network(maps, speed, state)
            inside = torch.tensor([start + age < self.frames[name].stop for name, start, _ in places])
            errors = registered_loss(output.offset, truth, self.avatar.cells)
            loss = loss + torch.where(inside, errors, 0.0).mean() / SEGMENT
        if not loss.isfinite():
            raise TrainingError(f"the error of the imitated maps is {float(loss.detach())}")
        loss.backward()
        return Progress(float(loss.detach()), None)

    def _draw(self, rng: np.random.Generator) -> tuple[str, int, bool]:
        """Return sequence, first frame and whether its mirror image is seen."""
        name = self.names[rng.choice(len(self.names), p=self.lengths / self.lengths.sum())]
        frames = self.frames[name]
        latest = max(frames.stop - SEGMENT, frames.start)
        start = frames.start if rng.random() < FROM_REST else int(rng.integers(frames.start, latest + 1))
        return name, start, bool(rng.random() < self.mirrored)

    @torch.no_grad()
    def _lesson(
        self, track: Float[Tensor, "f j 4 4"], offset: Float[Tensor, "f 3 h w"], *, mirrored: bool
    ) -> _Lesson:
        avatar = self.avatar
        if mirrored:
            track, offset = mirror_track(track), mirror_offset(offset, avatar.cells, avatar.mirror)
        seen = [avatar.see(contexts(track, frames))[:2] for frames in torch.arange(len(track)).split(32)]
        maps, speed = (torch.cat(parts) for parts in zip(*seen, strict=True))
        return _Lesson(maps, speed, offset)
