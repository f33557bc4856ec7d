"""Which way is up, found from where trunks, legs and floors are; files seldom say it."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from dsar.body.model import JOINT_NAMES

Up = Literal["y", "z"]
"""What a user may say is up."""

_AXES = {
    sign + letter: (-1.0 if sign else 1.0) * torch.eye(3)["xyz".index(letter)]
    for sign in ("", "-")
    for letter in "yzx"
}
_SAMPLES = 500
"""Frames that are looked at, evenly spread."""
_UPRIGHT, _SEATED = 0.7, -0.1
"""Cosines with up: of the trunk (to 45 degrees), and of the way from ankles to pelvis (seated: about 0)."""
_SOMETIMES, _USUALLY = 0.15, 0.5
"""Shares of the frames: upright now and then; upright as a rule."""
_FLOOR, _HIPS, _LEVEL = (-0.1, 0.35), 0.07, 0.15
"""Metres: where the lowest joint is of who is on a floor at zero, and above what the hips are, even of who
lies; by how much a floor's level may vary."""
_STILL = 0.01
"""Metres: hips that move less were never placed in a world."""


@dataclass(frozen=True)
class UpAxis:
    """Which way is up, and how we know."""

    axis: str
    """`y`, `z`, `x`, or one of them after a minus sign."""
    reason: str
    """In words, for the log."""
    certain: bool = True
    """False where the frames contradict each other, or the custom of the format."""


def trunk_and_leg_directions(
    joints: Float[Tensor, "f j 3"],
) -> tuple[Float[Tensor, "f 3"], Float[Tensor, "f 3"]]:
    """Return the directions from the pelvis to the neck, and from the ankles to the pelvis."""
    at = JOINT_NAMES.index
    ankles = (joints[:, at("left_ankle")] + joints[:, at("right_ankle")]) / 2
    pelvis = joints[:, at("pelvis")]
    return normalize(joints[:, at("neck")] - pelvis, dim=-1), normalize(pelvis - ankles, dim=-1)


def detect_up_axis(joints: Float[Tensor, "f j 3"], convention: str) -> UpAxis:
    """Return which axis is up in a motion.

    People are upright most of the time, and stand on one level. Who lies all the time tells nothing: then
    it is as the format's custom has it.

    Args:
        joints: At least SMPL-X's first 22, metres, in the file's world.
        convention: Axis that is up in most files of the format.
    """
    joints = joints[torch.linspace(0, len(joints) - 1, min(len(joints), _SAMPLES)).long()]
    trunk, legs = trunk_and_leg_directions(joints)
    placed = float((joints[:, 0].amax(0) - joints[:, 0].amin(0)).max()) > _STILL
    upright, level, floor = {}, {}, {}
    for name, axis in _AXES.items():
        upright[name] = _fraction((trunk @ axis.to(trunk) > _UPRIGHT) & (legs @ axis.to(legs) > _SEATED))
        heights = joints @ axis.to(joints)
        low, hips = heights.amin(1), heights[:, 0]
        level[name] = _fraction((low - low.median()).abs() < _LEVEL) if placed else 0.0
        on_floor = (low > _FLOOR[0]) & (low < _FLOOR[1]) & (hips > _HIPS)
        floor[name] = _fraction(on_floor) if placed else 0.0
    likely = [name for name in _AXES if upright[name] >= _SOMETIMES]
    steady = [name for name in likely if level[name] > max(level[other] for other in likely) - 0.2]
    best_axis = max(steady, key=lambda name: (floor[name] > 0.8, upright[name]), default=convention)
    if convention in steady and upright[convention] > upright[best_axis] / 3:
        best_axis = convention
    fraction = f"the trunk is upright in {upright[best_axis]:.0%} of the frames"
    if best_axis == convention:
        return UpAxis(convention, fraction if likely else "no frame tells, so as is the custom", bool(likely))
    if upright[convention] < _SOMETIMES and floor[convention] > 0.8 and floor[best_axis] < 0.5:
        reason = f"the figure keeps to the floor, though its head points along {best_axis.upper()}"
        return UpAxis(convention, reason, certain=False)
    if upright[best_axis] < _USUALLY and (upright[convention] >= _SOMETIMES or floor[best_axis] < 0.8):
        return UpAxis(convention, "the trunk is seldom upright, so as is the custom", certain=False)
    return UpAxis(best_axis, fraction, certain=False)


def rotation_to_y_up(axis: str) -> Float[Tensor, "3 3"]:
    """Return the rotation, by quarter turns, that carries an axis such as `z` or `-y` to +Y."""
    sign, index = (-1.0 if axis[0] == "-" else 1.0), "xyz".index(axis[-1])
    if index == 1:
        return torch.diag(torch.tensor([1.0, sign, sign]))
    rotation = torch.zeros(3, 3)
    rotation[1, index], rotation[index, 1] = sign, -sign
    rotation[2 - index, 2 - index] = 1.0
    return rotation


def _fraction(frames: Tensor) -> float:
    return float(frames.float().mean())
