"""Where a run stands: the three stages and everything that changes with progress."""

import math
from dataclasses import dataclass
from typing import Literal

from dsar.config import ScheduleConfig

Stage = Literal["template", "pose", "autoregressive"]

WHOLE_CLIP = 1_000_000
"""A horizon longer than any clip."""


@dataclass(frozen=True)
class Position:
    """The settings of one update."""

    stage: Stage
    """`template` fits the template alone, `pose` the network without streams, then everything."""
    horizon: int
    """Frames after which a rollout restarts at a random place; WHOLE_CLIP: at its sequence's end."""
    reduction: int
    """Factor by which images are reduced."""
    network_rate: float
    """Learning rate of the network."""
    template_factor: float
    """Factor on the template's learning rates."""


def position(schedule: ScheduleConfig, progress: float, step: int) -> Position:
    """Return the settings at a progress in [0, 1)."""
    reduction = 2 if progress < schedule.half_resolution_share else 1
    if progress < schedule.template_share:
        return Position("template", 1, reduction, 0.0, 1.0)
    trained = (progress - schedule.template_share) / (1 - schedule.template_share)
    cosine = 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * trained))
    warmup = min(1.0, (1 + step) / max(schedule.warmup, 1))
    rate = schedule.learning_rate * cosine * warmup
    factor = schedule.template_rate * cosine
    streams_from = schedule.template_share + schedule.pose_share
    if progress < streams_from:
        return Position("pose", schedule.horizon, reduction, rate, factor)
    grown = (progress - streams_from) / (1 - streams_from)
    doublings = int(grown * 8)
    horizon = schedule.horizon * 2**doublings if doublings < 4 else WHOLE_CLIP
    return Position("autoregressive", horizon, reduction, rate, factor)
