"""Whether a motion is one that people make: judged before a frame is drawn."""

import logging

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dsar.body.model import JOINT_NAMES
from dsar.data.motions.kinematics import JointTrajectories
from dsar.data.motions.up_axis import trunk_and_leg_directions
from dsar.errors import MotionError

_FLAT, _DOWN = 0.35, -0.35
"""Cosines with up: below the first the trunk lies, below the second the head is under the hips."""
_FOLDED_COSINE = 0.8
"""Cosine of trunk and thighs beyond which the chest lies on the legs."""
_OFTEN = 0.3
"""Share of the frames that a floor exercise or a bow seldom fills."""
_ALWAYS = 0.95
"""Share of the frames in which nobody is folded."""
_FLOATING, _SUNK, _FAR, _JUMP = 0.3, -0.15, 10.0, 15.0
"""Metres: lowest joint above and below the ground, way from the origin; metres a second: hips."""
LOGGER = logging.getLogger(__name__)


def check_plausibility(motion: JointTrajectories) -> list[str]:
    """Return, and log as warnings, what looks wrong with a motion and what would mend it.

    Args:
        motion: The body's joints in the Y-up world.

    Raises:
        MotionError: nobody can move like this: places are not finite, or the chest is on the legs throughout.
    """
    joints = motion.positions
    if not joints.isfinite().all():
        raise MotionError(f"motion {motion.name}: joints are not finite; the file or its skeleton is damaged")
    trunk, legs = trunk_and_leg_directions(joints)
    thighs = torch.stack(
        [_direction(joints, f"{side}_knee", f"{side}_hip") for side in ("left", "right")]
    ).mean(0)
    folded = _fraction((trunk * thighs).sum(-1) < -_FOLDED_COSINE)
    if folded > _ALWAYS:
        raise MotionError(
            f"motion {motion.name}: the figure's chest is folded onto its legs in {folded:.0%} of the "
            "frames; its rest pose or its joints are not what they are taken for: export it in a T-pose"
        )
    turned = "if it should stand, say --up y or --up z"
    lies = (trunk[:, 1].abs() < _FLAT) & (legs[:, 1].abs() < _FLAT)
    fractions = [
        (_fraction(lies), f"the figure lies; {turned}"),
        (_fraction((trunk[:, 1] < _DOWN) & (legs[:, 1] < _DOWN)), f"the figure is upside down; {turned}"),
        (folded, "the figure is folded onto its legs; export it in a T-pose if it should not be"),
    ]
    faults = [
        f"{fault} (in {fraction:.0%} of the frames)" for fraction, fault in fractions if fraction > _OFTEN
    ]
    faults += _position_faults(joints, motion.fps)
    for fault in faults:
        LOGGER.warning("Motion %s: %s", motion.name, fault)
    return faults


def _position_faults(joints: Tensor, fps: float) -> list[str]:
    """Return what is wrong with where a figure is."""
    low, hips = joints[:, :, 1].amin(1), joints[:, 0]
    faults = []
    if low.quantile(0.05) > _FLOATING:
        faults.append(
            f"the feet never come nearer than {low.min():.2f} m to the ground at y = 0; "
            "move the file's root down if they should stand"
        )
    sunk = _fraction(low < _SUNK)
    if sunk > _OFTEN:
        faults.append(
            f"the feet are under the ground at y = 0, by {-low.median():.2f} m, in {sunk:.0%} of the frames; "
            "move the file's root up if they should stand"
        )
    away = hips[:, [0, 2]].norm(dim=1).median()
    if away > _FAR:
        faults.append(
            f"the figure is {away:.0f} m away from the origin, where the cameras look; move the file's root "
            "there, or write it in metres if it is in centimetres"
        )
    speeds = hips.diff(dim=0).norm(dim=1) * fps
    jumps = (speeds > _JUMP).nonzero()[:, 0]
    if len(jumps):
        faults.append(
            f"the hips jump {speeds.max() / fps:.2f} m from one frame to the next ({len(jumps)}x, "
            f"first after frame {int(jumps[0])}); is {fps:g} fps its rate (--motion-fps), its unit a metre?"
        )
    return faults


def _direction(joints: Tensor, start: str, end: str) -> Tensor:
    at = JOINT_NAMES.index
    return normalize(joints[:, at(end)] - joints[:, at(start)], dim=-1)


def _fraction(frames: Tensor) -> float:
    return float(frames.float().mean())
