"""Whether an avatar has seen the like of a motion: its poses and its speed."""

import logging
from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.data.motions.mmd import FAR, NEAR, motion_mmd
from dsar.data.motions.up_axis import joint_positions
from dsar.types import Body, Motion

FAST_QUANTILE = 0.999
"""Share of the training frames that is slower than what counts as fast."""
_LISTED = 5
LOGGER = logging.getLogger(__name__)


def joint_speeds(body: Body, motion: Motion) -> Float[Tensor, " f"]:
    """Return how fast the fastest joint moves from each frame to the next, metres a second."""
    return joint_positions(body, motion).diff(dim=0).norm(dim=-1).amax(1) * motion.fps


def frames_faster_than_training(
    body: Body, motion: Motion, training: Iterable[Motion]
) -> tuple[list[int], float]:
    """Return the frames of a motion that are faster than 999 of 1000 known ones, and that speed, m/s."""
    speeds = torch.cat([joint_speeds(body, each) for each in training])
    limit = float(speeds.quantile(FAST_QUANTILE)) if len(speeds) else 0.0
    return [int(frame) + 1 for frame in (joint_speeds(body, motion) > limit).nonzero()], limit


def log_out_of_distribution(body: Body, motion: Motion, training: Sequence[Motion], first: int) -> None:
    """Log how far a motion's poses are from training, and where it is faster than any of it.

    Args:
        body: Whose body moves.
        motion: What is new.
        training: What the avatar was trained with.
        first: Number of the motion's first frame.
    """
    if len(motion) > 1 and sum(map(len, training)) > 1:
        motions = {str(index): each for index, each in enumerate(training)}
        distance = motion_mmd(motions | {"new": motion}, list(motions), ["new"])
        LOGGER.info(
            "Motion %s: its poses' MMD from training is %.2f (near below %g, far above %g)",
            *(motion.name, distance, NEAR, FAR),
        )
    frames, limit = frames_faster_than_training(body, motion, training)
    if frames:
        some = ", ".join(str(first + frame) for frame in frames[:_LISTED])
        LOGGER.warning(
            "Motion %s: %d of %d frames are faster than any training (a joint above %.1f m/s): %s%s; clothes "
            "there are a guess. Is its frame rate right?",
            *(motion.name, len(frames), len(motion), limit, some, ", ..." if len(frames) > _LISTED else ""),
        )
