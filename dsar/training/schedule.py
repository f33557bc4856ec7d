"""Where a run stands: the three stages and everything that changes with progress."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

from dsar.config import ScheduleConfig

Stage = Literal["template", "pretraining", "pose", "autoregressive"]

WHOLE_CLIP = 1_000_000
"""More frames than any clip has."""


@dataclass(frozen=True)
class ScheduleState:
    """The settings of one update."""

    stage: Stage
    """`template` fits the template alone, `pretraining` the network to registered maps, `pose` the network
    without the two streams, then everything."""
    max_rollout_frames: int
    """Frames after which a rollout restarts at a random place; WHOLE_CLIP: at its sequence's end."""
    reduction: int
    """Factor by which images are reduced."""
    network_rate: float
    """Adam's learning rate for the network."""
    muon_rate: float
    """Muon's learning rate for the network's hidden convolutions."""
    template_factor: float
    """Factor on the template's learning rates."""


def schedule_at(schedule: ScheduleConfig, progress: float) -> ScheduleState:
    """Return the settings at a progress in [0, 1)."""
    if progress < schedule.template_fraction:
        factor = _cosine(progress / schedule.template_fraction, 0.1)
        return ScheduleState("template", 1, 1, 0.0, 0.0, factor)
    reduction = 2 if progress < schedule.half_resolution_fraction else 1
    images_from = schedule.template_fraction + schedule.pretraining_fraction
    if progress < images_from:
        rates = _rates(schedule, (progress - schedule.template_fraction) / schedule.pretraining_fraction)
        return ScheduleState("pretraining", WHOLE_CLIP, reduction, *rates, 0.0)
    trained = (progress - images_from) / (1 - images_from)
    scale = schedule.finetuning_factor if schedule.pretraining_fraction else 1.0
    rates = _rates(schedule, trained, scale)
    factor = schedule.template_rate * _cosine(trained, 0.02)
    max_rollout_frames = schedule.max_rollout_frames or WHOLE_CLIP
    feedback_from = images_from + schedule.pose_only_fraction
    if progress < feedback_from:
        return ScheduleState("pose", max_rollout_frames, reduction, *rates, factor)
    grown = (progress - feedback_from) / (1 - feedback_from)
    doublings = int(grown * 8)
    max_rollout_frames = max_rollout_frames * 2**doublings if doublings < 4 else WHOLE_CLIP
    return ScheduleState("autoregressive", max_rollout_frames, reduction, *rates, factor)


def without_pretraining(schedule: ScheduleConfig) -> ScheduleConfig:
    """Return the schedule of a run that has no registered maps to train on."""
    return dataclasses.replace(schedule, pretraining_fraction=0.0)


def _rates(schedule: ScheduleConfig, trained: float, scale: float = 1.0) -> tuple[float, float]:
    """Return the network's rates, which rise from zero and fall along a cosine, at a share of a stage."""
    warm = scale * _cosine(trained, 0.02) * min(1.0, (trained + 1e-3) / max(schedule.warmup, 1e-3))
    return schedule.learning_rate * warm, schedule.muon_rate * warm


def _cosine(progress: float, end: float) -> float:
    """Return half a cosine from 1 at progress 0 to `end` at 1."""
    return end + (1 - end) * 0.5 * (1 + math.cos(math.pi * progress))
