"""Where a body's joints are throughout a motion: computed once, for all that judges the motion."""

from dataclasses import dataclass
from functools import cached_property

from jaxtyping import Float
from torch import Tensor

from dsar.body.skinning import forward_kinematics
from dsar.types import Body, Motion


@dataclass(frozen=True)
class JointTrajectories:
    """A motion's joints in the world, by frame."""

    transforms: Float[Tensor, "f j 4 4"]
    """Where each joint carries points of the rest pose (T_world_rest)."""
    positions: Float[Tensor, "f j 3"]
    """World metres."""
    fps: float
    """Frames per second."""
    name: str
    """Label of the motion."""

    @cached_property
    def speeds(self) -> Float[Tensor, " g"]:
        """Speed of the fastest joint from each frame to the next, metres a second."""
        return self.positions.diff(dim=0).norm(dim=-1).amax(1) * self.fps


def trace_joints(body: Body, motion: Motion) -> JointTrajectories:
    """Return where a body's joints are in a motion."""
    transforms = forward_kinematics(body, motion.rotations, motion.translations)
    positions = (transforms[..., :3, :3] @ body.joints[:, :, None])[..., 0] + transforms[..., :3, 3]
    return JointTrajectories(transforms, positions, motion.fps, motion.name)
