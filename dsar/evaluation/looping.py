"""Long rollouts: a motion repeated many times, and whether its last round is as good as its first."""

import dataclasses

import torch
from jaxtyping import Int64
from torch import Tensor

from dsar.data.motions.files import resample
from dsar.types import Motion


def loop_motion(motion: Motion, rounds: int, bridge: float = 1.0) -> tuple[Motion, int]:
    """Return a motion repeated, and the frames of a round.

    From a round's last pose to the next one's first the body takes `bridge` seconds, and stands in it for as
    long: cloth starts every round at rest, as it does in the first.
    """
    ends, still = (
        torch.tensor([len(motion) - 1, 0]),
        torch.zeros(round(bridge * motion.fps), dtype=torch.int64),
    )
    way = resample(dataclasses.replace(_pick(motion, ends), fps=1 / bridge), motion.fps)
    parts = (motion, way, _pick(motion, still))
    rotations = torch.cat([part.rotations for part in parts])
    translations = torch.cat([part.translations for part in parts])
    once = dataclasses.replace(motion, rotations=rotations, translations=translations)
    return _pick(once, torch.arange(len(once)).repeat(rounds)), len(once)


def _pick(motion: Motion, frames: Int64[Tensor, " n"]) -> Motion:
    return dataclasses.replace(
        motion, rotations=motion.rotations[frames], translations=motion.translations[frames]
    )
