"""How long a garment moves on after its wearer has stopped."""

from jaxtyping import Float
from torch import Tensor


def rms_speeds(points: Float[Tensor, "f p 3"], fps: float) -> Float[Tensor, " g"]:
    """Return the root mean square speed of points, m/s, from each frame to the next."""
    return points.diff(dim=0).mul(fps).square().sum(-1).mean(-1).sqrt()


def settling_time(speeds: Float[Tensor, " g"], start: int, end: int, slow: float, fps: float) -> float:
    """Return the seconds from frame `start` until speeds stay below `slow` up to frame `end`.

    A garment that is still faster at the end has not settled: the whole stretch counts.
    """
    fast = (speeds[start:end] >= slow).nonzero()
    return (int(fast[-1]) + 1) / fps if len(fast) else 0.0
