"""The stability battery: what a rollout does where rollouts fail. It needs no truth and no licence."""

from collections.abc import Iterator, Mapping

import torch

from dsar.avatar.avatar import Avatar
from dsar.errors import MotionError
from dsar.evaluation.stress.invariance import run_causal, run_noise, run_rate, run_teleport
from dsar.evaluation.stress.memory import run_cold, run_cycle, run_gap, run_long, run_stop, run_twin
from dsar.evaluation.stress.pictures import run_empty, run_precision
from dsar.evaluation.stress.prior import run_prior
from dsar.evaluation.stress.strain import (
    run_contact,
    run_extreme,
    run_floor,
    run_ood,
    run_scale,
    run_shear,
)
from dsar.evaluation.stress.verdicts import BatteryVerdict, Case, CaseVerdict, Moment
from dsar.types import Motion

LEAST_FRAMES = 4
"""Of the motion from which all cases are made."""
CASES: Mapping[str, Case] = {
    "long": run_long,
    "cycle": run_cycle,
    "twin": run_twin,
    "teleport": run_teleport,
    "stop": run_stop,
    "rate": run_rate,
    "gap": run_gap,
    "noise": run_noise,
    "ood": run_ood,
    "contact": run_contact,
    "shear": run_shear,
    "cold": run_cold,
    "precision": run_precision,
    "empty": run_empty,
    "causal": run_causal,
    "floor": run_floor,
    "extreme": run_extreme,
    "scale": run_scale,
    "prior": run_prior,
}


@torch.no_grad()
def stress(
    avatar: Avatar, motion: Motion, cases: Mapping[str, Case] = CASES
) -> Iterator[tuple[str, CaseVerdict]]:
    """Yield the verdict of each case on a motion at the avatar's frame rate.

    Raises:
        MotionError: the motion is too short to stop, to leave out frames of, or to part in its middle.
    """
    if len(motion) < LEAST_FRAMES:
        raise MotionError(
            f"motion {motion.name} has {len(motion)} frames, the battery needs {LEAST_FRAMES} or more: give "
            "the capture a longer test sequence"
        )
    for name, case in cases.items():
        yield name, case(avatar, motion)


__all__ = [
    "CASES",
    "LEAST_FRAMES",
    "BatteryVerdict",
    "Case",
    "CaseVerdict",
    "Moment",
    "run_causal",
    "run_cold",
    "run_contact",
    "run_cycle",
    "run_empty",
    "run_extreme",
    "run_floor",
    "run_gap",
    "run_long",
    "run_noise",
    "run_ood",
    "run_precision",
    "run_prior",
    "run_rate",
    "run_scale",
    "run_shear",
    "run_stop",
    "run_teleport",
    "run_twin",
    "stress",
]
