"""Rollouts as the battery looks at them.

All cases look at the offsets of the control points, metres along the body's own axes, in which neither the
body's pose nor its place shows.
"""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.player import NetworkFrame, Player
from dsar.evaluation.stress.verdicts import Moment
from dsar.network import NetworkOutput
from dsar.types import Gaussians, Motion

AROUND = (-8, -4, 0, 4, 8)
"""Frames of a moment, counted from its worst."""
MILLIMETRES = 1000.0


class Rollout:
    """An avatar's rollout of a motion from a cold start."""

    def __init__(self, avatar: Avatar, motion: Motion) -> None:
        """Prepare; nothing is computed before it is asked for."""
        self.avatar = avatar
        self.player = Player(avatar, avatar.driving_signal(motion))

    def frames(self) -> Iterator[NetworkFrame]:
        """Yield each frame; on a GPU its output lasts until the next."""
        for _ in range(len(self.player.signal)):
            yield self.player.forward_frame()

    def offsets(self) -> Iterator[Float[Tensor, "p 3"]]:
        """Yield each frame's offsets of the control points, metres."""
        for frame in self.frames():
            yield control_offsets(self.avatar, frame.output)[0].clone()

    def moment(self, worst: int) -> Moment:
        """Return how some frames around one look."""
        frames = around(worst, len(self.player.signal))
        gaussians = []
        for frame in frames:
            self.player.seek(frame)
            gaussians.append(self.player.step().gaussians.map(lambda value: value.detach().cpu().clone()))
        return Moment(frames, tuple(gaussians))


def around(worst: int, length: int) -> tuple[int, ...]:
    """Return the frames of a moment, of those that a motion has."""
    return tuple(frame for step in AROUND if 0 <= (frame := worst + step) < length)


def posed(avatar: Avatar, window: Float[Tensor, "1 t j 4 4"], output: NetworkOutput) -> Gaussians:
    """Return a frame as it looks, in main memory."""
    return avatar.gaussians(window, output)[0].map(lambda value: value.detach().cpu().clone())


def roll_offsets(avatar: Avatar, motion: Motion) -> Float[Tensor, "f p 3"]:
    """Return the offsets of the control points in all frames of a rollout, metres."""
    return torch.stack(list(Rollout(avatar, motion).offsets()))


def control_offsets(avatar: Avatar, output: NetworkOutput) -> Float[Tensor, "b p 3"]:
    """Return an output's offsets at the control points, metres."""
    return avatar.gather_control_points(output.offset)


def rms_distance(one: Float[Tensor, "*s p 3"], other: Float[Tensor, "*s p 3"]) -> Float[Tensor, "*s"]:
    """Return root mean square distances of the points, mm."""
    return (one - other).square().sum(-1).mean(-1).sqrt() * MILLIMETRES


def seconds_apart(distances: Float[Tensor, " f"], limit: float, fps: float) -> Tensor:
    """Return after how many seconds distances are below a limit for good; 0 where they always are."""
    wrong = (~(distances < limit)).nonzero()
    return torch.tensor((int(wrong[-1]) + 1) / fps if len(wrong) else 0.0)


def draw_noise(like: Tensor, generator: torch.Generator) -> Tensor:
    """Return standard normal numbers, drawn in main memory: the same on any device."""
    return torch.randn(like.shape, generator=generator).to(like.device)


def worst_of(values: Tensor | Sequence[float]) -> int:
    """Return where the largest value is; the first that is not a number counts as that."""
    values = torch.as_tensor(values)
    return int(torch.where(values.isfinite(), values, torch.inf).argmax())
