"""What training shows of input maps and outputs: the measures by which rollouts are guarded.

Every limit is training's own largest, found by rolling the trained avatar out over its training motions; no
limit is a number of ours. Guards act from some times that on, so that they cannot act on those motions.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.network import NetworkOutput

FAR_MARGIN = 1.5
"""How many times training's farthest frame a frame may be from its mean until a warning (field study 9.4)."""
BREAKING_MARGIN = 3.0
"""How many times training's largest an output may be until it is replaced. Sound frames of unseen motions
reach 2.4 (a wool skirt in a squat); what feeds on itself passes any number."""
JITTER_SECONDS = 0.25
"""Time constant of the mean of the jitter: one sharp step is no trembling."""


@dataclass(frozen=True)
class GuardLimits:
    """Training's largest values, and its mean, on the network's grid and at the avatar's frame rate."""

    mean: Float[Tensor, "c h w"]
    """Of the standardised input maps over the training frames."""
    distances: Float[Tensor, " g"]
    """Largest distance from the mean, of each three channels: position, velocity and so on."""
    offset: float
    """Largest component of an offset, metres."""
    appearance: float
    """Largest residual of an appearance."""
    jitter: float
    """Largest jitter (see `Jitter`), metres per frame squared."""

    def distance(self, maps: Float[Tensor, "1 c h w"]) -> Float[Tensor, ""]:
        """Return how far standardised input maps are from training's mean, 1 being its farthest frame."""
        return (squared_distances(maps, self.mean).sqrt() / self.distances).amax()

    def size(self, output: NetworkOutput) -> Float[Tensor, ""]:
        """Return how large an output is, 1 being training's largest; not finite where the output is not."""
        offset, appearance = (part.abs().amax() for part in (output.offset, output.appearance))
        return torch.maximum(offset / self.offset, appearance / self.appearance)

    def to(self, device: torch.device) -> "GuardLimits":
        """Return the same limits on a device."""
        mean, distances = self.mean.to(device), self.distances.to(device)
        return GuardLimits(mean, distances, self.offset, self.appearance, self.jitter)


@dataclass(frozen=True)
class Jitter:
    """How much offsets tremble: running mean of the squared second difference in time, over the grid.

    Immutable: a step returns the next.
    """

    decay: float
    """By which the mean forgets in a frame."""
    offsets: tuple[Float[Tensor, "1 3 h w"], ...] = ()
    """Up to two last frames', newest last."""
    mean_square: float = 0.0
    """In the newest frame."""

    @classmethod
    def at_rate(cls, fps: float) -> "Jitter":
        """Return the jitter of a rollout that has not begun, at a frame rate."""
        return cls(math.exp(-1 / (JITTER_SECONDS * fps)))

    def change(self, offset: Float[Tensor, "1 3 h w"]) -> Float[Tensor, ""]:
        """Return the mean square of the second difference that a new offset makes; 0 in the first frames."""
        if len(self.offsets) < 2:
            return offset.new_zeros(())
        before, last = self.offsets
        return (offset - 2 * last + before).square().mean()

    def step(self, offset: Float[Tensor, "1 3 h w"], change: float) -> "Jitter":
        """Return the jitter one frame on, whose change is known."""
        mean_square = self.decay * self.mean_square + (1 - self.decay) * change
        return Jitter(self.decay, (*self.offsets[-1:], offset), mean_square)

    @property
    def size(self) -> float:
        """Root of the mean, metres per frame squared."""
        return math.sqrt(self.mean_square)


def squared_distances(maps: Float[Tensor, "b c h w"], mean: Float[Tensor, "c h w"]) -> Float[Tensor, " g"]:
    """Return the mean square difference from a mean, of each three channels of the grid."""
    return (maps - mean).square().mean((0, 2, 3)).unflatten(0, (-1, 3)).mean(1)
