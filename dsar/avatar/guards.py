"""The guards: every limit on what drives an avatar and on what its network adds, and which of them fired.

A network knows what it was trained on. A glitch of a capture, a cut or a teleport must neither explode it nor
stay in its memory; so what it sees is cut to what a person can do, and what it says to what cloth can.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from jaxtyping import Int
from torch import Tensor


@dataclass(frozen=True)
class Limits:
    """Where each guard begins."""

    jump_speed: float = 12.0
    """Speed of the pelvis, m/s, above which a frame is a discontinuity: a cut or a teleport."""
    jump_angular_speed: float = 20 * math.pi
    """Angular speed of the pelvis, rad/s, above which it is one, too: no skater turns ten times a second."""
    cut_speed: float = 6.0
    """Mean speed of the body's joints as the pelvis sees them, m/s, above which a frame begins another shot:
    a sprinter's is below 4, for only the feet are fast."""
    speed: float = 0.4
    """Metres per 1/30 s (12 m/s) at which velocities of control points are cut for the network."""
    lag: float = 1.0
    """Metres at which the way of a control point from its running mean is cut: an arm's length and more."""
    pose: float = 2.0
    """Standard deviations of a principal component that a pose may be away from the mean of training, where
    the network takes poses by their principal components (`model.pose_components`)."""
    offset: float = 0.9
    """Fraction of `model.offset_limit` from which on a component of an offset counts as limited: without the
    network's hyperbolic tangent it would be more than 1.47 times the limit."""


LIMITS = Limits()
"""The limits of all avatars."""


class Guard(StrEnum):
    """What a guard watches."""

    JUMP = "jump"
    """The body is where it cannot have come from the frame before: its past goes with it."""
    CUT = "cut"
    """The pose cannot have come from the frame before: the clothes begin anew, as in a first frame."""
    SPEED = "speed"
    """A control point's velocity was cut."""
    LAG = "lag"
    """A control point's way from a running mean was cut."""
    POSE = "pose"
    """A principal component of the pose was moved into the range of training."""
    OFFSET = "offset"
    """An offset of the network came near its limit."""
    FAR = "far"
    """The input maps are far from training's: nothing is changed, the user is warned."""
    FINITE = "finite"
    """The network's output has values that are not finite: the frame is replaced (see `watchdog`)."""
    SIZE = "size"
    """An offset or a residual is far beyond training's largest: the frame is replaced."""
    JITTER = "jitter"
    """The offsets tremble beyond what training shows: the frame is replaced."""


GuardCounts = Mapping[Guard, Int[Tensor, " b"]]
"""How many values each guard limited in each frame of a batch; those of points, components or whole bodies.

Tensors, so that nothing waits for a GPU before somebody asks.
"""


def fired(counts: GuardCounts, entry: int = 0) -> frozenset[Guard]:
    """Return the guards that limited anything in one frame of a batch."""
    return frozenset(guard for guard, values in counts.items() if values[entry] > 0)
