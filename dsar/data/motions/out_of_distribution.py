"""Whether an avatar has seen the like of a motion: its poses and its speed."""

import logging
from collections.abc import Iterable, Sequence

import torch

from dsar.data.motions.kinematics import JointTrajectories, trace_joints
from dsar.data.motions.mmd import FAR, NEAR, PoseDistribution
from dsar.types import Body, Motion

FAST_QUANTILE = 0.999
"""Share of the training frames that is slower than what counts as fast."""
_LISTED = 5
LOGGER = logging.getLogger(__name__)


def frames_faster_than_training(
    motion: JointTrajectories, training: Iterable[JointTrajectories]
) -> tuple[list[int], float]:
    """Return the frames of a motion that are faster than 999 of 1000 of training, and that speed, m/s."""
    speeds = torch.cat([trajectories.speeds for trajectories in training])
    limit = float(speeds.quantile(FAST_QUANTILE)) if len(speeds) else 0.0
    return [int(frame) + 1 for frame in (motion.speeds > limit).nonzero()], limit


def log_out_of_distribution(body: Body, motion: Motion, training: Sequence[Motion], first_frame: int) -> None:
    """Log how far a motion's poses are from training, and where it is faster than any of it.

    Args:
        body: Whose body moves.
        motion: What is new.
        training: What the avatar was trained with.
        first_frame: Number of the motion's first frame.
    """
    if len(motion) > 1 and sum(map(len, training)) > 1:
        LOGGER.info(
            "Motion %s: its poses' MMD from training is %.2f (near below %g, far above %g)",
            *(motion.name, PoseDistribution.from_motions(training).mmd([motion]), NEAR, FAR),
        )
    frames, limit = frames_faster_than_training(
        trace_joints(body, motion), (trace_joints(body, known) for known in training)
    )
    if frames:
        listed = ", ".join(str(first_frame + frame) for frame in frames[:_LISTED])
        more = ", ..." if len(frames) > _LISTED else ""
        LOGGER.warning(
            "Motion %s: %d of %d frames are faster than any training (a joint above %.1f m/s): %s%s; clothes "
            "there are a guess. Is its frame rate right?",
            *(motion.name, len(frames), len(motion), limit, listed, more),
        )
