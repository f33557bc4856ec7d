"""Where a run stands: the three stages and everything that changes with progress."""

import math
from dataclasses import dataclass
from typing import Literal

from dsar.config import ScheduleConfig

Stage = Literal["template", "imitation", "pose", "autoregressive"]

WHOLE_CLIP = 1_000_000
"""A horizon longer than any clip."""


@dataclass(frozen=True)
class Position:
    """The settings of one update."""

    stage: Stage
    """`template` fits the template alone, `imitation` the network to registered maps, `pose` the network
    without streams, then everything."""
    horizon: int
    """Frames after which a rollout restarts at a random place; WHOLE_CLIP: at its sequence's end."""
    reduction: int
    """Factor by which images are reduced."""
    network_rate: float
    """Adam's learning rate for the network."""
    matrix_rate: float
    """Muon's learning rate for the network's hidden convolutions."""
    template_factor: float
    """Factor on the template's learning rates."""


def position(schedule: ScheduleConfig, progress: float) -> Position:
    """Return the settings at a progress in [0, 1)."""
    if progress < schedule.template_share:
        factor = _cosine(progress / schedule.template_share, 0.1)
        return Position("template", 1, 1, 0.0, 0.0, factor)
    reduction = 2 if progress < schedule.half_resolution_share else 1
    images_from = schedule.template_share + schedule.imitation_share
    if progress < images_from:
        rates = _rates(schedule, (progress - schedule.template_share) / schedule.imitation_share)
        return Position("imitation", WHOLE_CLIP, reduction, *rates, 0.0)
    trained = (progress - images_from) / (1 - images_from)
    scale = schedule.refinement if schedule.imitation_share else 1.0
    rates = _rates(schedule, trained, scale)
    factor = schedule.template_rate * _cosine(trained, 0.02)
    horizon = schedule.horizon or WHOLE_CLIP
    streams_from = images_from + schedule.pose_share
    if progress < streams_from:
        return Position("pose", horizon, reduction, *rates, factor)
    grown = (progress - streams_from) / (1 - streams_from)
    doublings = int(grown * 8)
    horizon = horizon * 2**doublings if doublings < 4 else WHOLE_CLIP
    return Position("autoregressive", horizon, reduction, *rates, factor)


def _rates(schedule: ScheduleConfig, trained: float, scale: float = 1.0) -> tuple[float, float]:
    """Return the network's rates, which rise from zero and fall along a cosine, at a share of a stage."""
    warm = scale * _cosine(trained, 0.02) * min(1.0, (trained + 1e-3) / max(schedule.warmup, 1e-3))
    return schedule.learning_rate * warm, schedule.matrix_rate * warm


def _cosine(progress: float, end: float) -> float:
    """Return half a cosine from 1 at progress 0 to `end` at 1."""
    return end + (1 - end) * 0.5 * (1 + math.cos(math.pi * progress))
