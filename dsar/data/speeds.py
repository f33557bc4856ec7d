"""How fast a body moves, and whether the avatar has seen the like."""

import logging
from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.body.model import Body
from dsar.body.skinning import forward_kinematics
from dsar.types import Motion

USUAL = 0.999
"""Share of the training frames that is slower than what counts as fast."""
_LISTED = 5
LOGGER = logging.getLogger(__name__)


def joint_speeds(body: Body, motion: Motion) -> Float[Tensor, " f"]:
    """Return how fast the fastest joint moves from each frame to the next, metres a second."""
    transforms = forward_kinematics(body, motion.rotations, motion.translations)
    joints = (transforms[..., :3, :3] @ body.joints[:, :, None])[..., 0] + transforms[..., :3, 3]
    return joints.diff(dim=0).norm(dim=-1).amax(1) * motion.fps


def unusual_frames(body: Body, motion: Motion, known: Iterable[Motion]) -> tuple[list[int], float]:
    """Return the frames of a motion that are faster than 999 of 1000 known ones, and that speed, m/s."""
    speeds = torch.cat([joint_speeds(body, each) for each in known])
    limit = float(speeds.quantile(USUAL)) if len(speeds) else 0.0
    return [int(frame) + 1 for frame in (joint_speeds(body, motion) > limit).nonzero()], limit


def warn_of_speed(body: Body, motion: Motion, known: Iterable[Motion], first: int) -> None:
    """Log where a motion is faster than what an avatar was trained with; `first` numbers its first frame."""
    frames, limit = unusual_frames(body, motion, known)
    if frames:
        some = ", ".join(str(first + frame) for frame in frames[:_LISTED])
        LOGGER.warning(
            "Motion %s: %d of %d frames are faster than any training (a joint above %.1f m/s): %s%s; clothes "
            "there are a guess. Is its frame rate right?",
            *(motion.name, len(frames), len(motion), limit, some, ", ..." if len(frames) > _LISTED else ""),
        )
