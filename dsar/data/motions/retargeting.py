"""Motion of a foreign skeleton for our body, whatever pose that skeleton rests in.

Each joint of ours takes the world rotation of its counterpart times a constant, which carries our rest pose
into the counterpart's axes. Where the skeleton rests as a person stands (T, A, lying, facing anywhere), the
constant turns the whole figure, and then each limb the shortest way. Where it does not (bones in one line,
as game engines have them), it is found from the motion: bones give directions, knees and elbows the roll of
limbs, and what remains is untwisted on average. Hips are where theirs are, scaled by the length of the legs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from dsar.body.model import JOINT_NAMES, PARENTS
from dsar.data.motions.joint_matching import SIDES, JointMatch
from dsar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle, nearest_rotation
from dsar.types import Body, Motion

_AT = {name: index for index, name in enumerate(JOINT_NAMES)}
_BODY_JOINTS = 22
_LIMBS = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}
_ENDS = _LIMBS | {"ankle": "foot", "collar": "shoulder"}
"""Where the bone ends that begins at a joint."""
_CHAINS = (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
_HINGES = {"leg": (1.0, 0.0, 0.0), "left": (0.0, -1.0, 0.0), "right": (0.0, 1.0, 0.0)}
"""About which axis of the rest pose knees and elbows bend: thigh x shin, upper arm x forearm."""
_STRAIGHT = 0.7
"""Cosine to which a standing person's trunk, thighs and shins are in one line."""
_SAME = 0.87
"""Cosine to which feet, hands and heads point as ours do at rest: they rest level, palms down, unbowed."""
_SNAP = 0.97
"""Cosine to which a rest pose's axes are an axis of the world."""
_BENT = 0.2
"""Mean sine of the angle at a knee or an elbow from which it tells how its limb is rolled."""


@dataclass(frozen=True)
class SkeletonClip:
    """A moving skeleton in the world."""

    rotations: Float[Tensor, "f j 3 3"]
    """World rotations of its joints."""
    positions: Float[Tensor, "f j 3"]
    """Their places, any unit."""
    parents: tuple[int, ...]
    tips: dict[int, Float[Tensor, "3"]]
    """Where the bones of last joints end, in their axes."""
    match: JointMatch

    def direction(self, above: int, below: int) -> Float[Tensor, "3"]:
        """Return the usual way from one joint to another, in the axes of the first."""
        return median_direction(self.rotations[:, above], self.positions[:, below] - self.positions[:, above])

    def bone(self, joint: int) -> Float[Tensor, "3"] | None:
        """Return where a hand or a head points, in its axes, if that can be known.

        Fingers show it. A single child may be a thumb, and an `End Site` anything: they count only where they
        go on in the line of the bone before.
        """
        children = [child for child, parent in enumerate(self.parents) if parent == joint]
        directions = [
            direction
            for direction in (self.direction(joint, child) for child in children)
            if direction.norm() > 0
        ]
        if len(directions) > 1:
            return torch.stack([normalize(direction, dim=0) for direction in directions]).mean(0)
        direction = directions[0] if directions else self.tips.get(joint, torch.zeros(3, dtype=torch.float64))
        before = self.direction(self.parents[joint], joint)
        return direction if normalize(direction, dim=0) @ normalize(before, dim=0) > _SAME else None


def median_direction(
    rotations: Float[Tensor, "f 3 3"], directions: Float[Tensor, "f 3"]
) -> Float[Tensor, "3"]:
    """Return the median of world vectors in the axes of turned joints."""
    return (rotations.mT @ directions[..., None])[..., 0].median(0).values


def bone_offsets(
    rotations: Float[Tensor, "f j 3 3"], positions: Float[Tensor, "f j 3"], parents: Sequence[int]
) -> Float[Tensor, "j 3"]:
    """Return the usual places of joints relative to their parents, in those' axes; zero at the root."""
    return torch.stack(
        [
            positions.new_zeros(3)
            if parent < 0
            else median_direction(rotations[:, parent], positions[:, joint] - positions[:, parent])
            for joint, parent in enumerate(parents)
        ]
    )


def body_joint_positions(match: JointMatch, positions: Float[Tensor, "*f j 3"]) -> Float[Tensor, "*f 22 3"]:
    """Return where our body joints are in a skeleton; those that it lacks are where their parents are."""
    known = match.limbs | {"pelvis": match.trunk[0], "spine3": match.trunk[-1]}
    if match.head is not None:
        known |= {"head": match.head, "neck": (*match.neck, match.head)[0]}
    index: list[int] = []
    for name, parent in zip(JOINT_NAMES[:_BODY_JOINTS], PARENTS, strict=False):
        index.append(known[name] if name in known else index[parent])
    joints = positions[..., index, :].clone()
    if match.head is None:
        shoulders = joints[..., [_AT["left_shoulder"], _AT["right_shoulder"]], :].mean(-2)
        joints[..., [_AT["neck"], _AT["head"]], :] = shoulders[..., None, :]
    return joints


def leg_length(joints: Float[Tensor, "*f j 3"]) -> Float[Tensor, "*f"]:
    """Return the mean length of thigh and shin together."""
    ends = [[_AT[f"{side}_{joint}"] for side in SIDES] for joint in ("hip", "knee", "ankle")]
    hips, knees, ankles = (joints[..., end, :] for end in ends)
    return ((hips - knees).norm(dim=-1) + (knees - ankles).norm(dim=-1)).mean(-1)


def find_standing_rest(
    match: JointMatch, bones: Float[Tensor, "j 3"], parents: Sequence[int]
) -> Tensor | None:
    """Return the rotation from our rest pose's world to that of a skeleton that rests as a person stands.

    Returns:
        Its columns are where the figure's left, its head and its front point, axes of the world where they
        are nearly so; None where the skeleton rests in no person's pose.
    """
    positions = torch.zeros_like(bones)
    for joint, parent in enumerate(parents):
        positions[joint] = bones[joint] + (positions[parent] if parent >= 0 else 0)
    joints = body_joint_positions(match, positions)
    start = [_AT[name] for name in ("pelvis", *(f"{side}_{j}" for j in ("knee", "ankle") for side in SIDES))]
    end = [_AT[name] for name in ("neck", *(f"{side}_{j}" for j in ("hip", "knee") for side in SIDES))]
    upwards = normalize(joints[end] - joints[start], dim=-1)
    up = _snap(normalize(upwards[0] + upwards[1:].mean(0), dim=0))
    across = joints[_AT["left_hip"]] - joints[_AT["right_hip"]]
    if (upwards @ up).min() < _STRAIGHT or abs(float(normalize(across, dim=0) @ up)) > 0.5:
        return None
    left = _snap(normalize(across - (across @ up) * up, dim=0))
    left = normalize(left - (left @ up) * up, dim=0)
    return torch.stack([left, up, torch.linalg.cross(left, up)], 1)


def retarget(clip: SkeletonClip, rest: Tensor | None, body: Body, fps: float, name: str) -> Motion:
    """Return the motion of a body that does what a skeleton does in the Y-up world, float32.

    Args:
        clip: The skeleton, Y up.
        rest: How it rests (`find_standing_rest`).
        body: Who moves.
        fps: Frames per second.
        name: The motion's name.
    """
    joints = body.joints.double()
    rotations = (
        _rotations_from_rest(clip, rest, joints) if rest is not None else _rotations_from_motion(clip, joints)
    )
    world = torch.eye(3, dtype=torch.float64).repeat(len(clip.rotations), len(JOINT_NAMES), 1, 1)
    for ours in range(_BODY_JOINTS):
        name_here, parent = JOINT_NAMES[ours], body.parents[ours]
        world[:, ours] = rotations[name_here] if name_here in rotations else world[:, parent]
    local = torch.stack([world[:, max(p, 0)].mT @ world[:, j] for j, p in enumerate(body.parents)], 1)
    local[:, 0] = world[:, 0]
    local[:, _BODY_JOINTS:] = torch.eye(3, dtype=torch.float64)
    theirs = body_joint_positions(clip.match, clip.positions)
    scale = leg_length(joints) / leg_length(theirs).median()
    hips = [_AT["left_hip"], _AT["right_hip"]]
    ours = (world[:, 0] @ (joints[hips].mean(0) - joints[0])[:, None])[..., 0]
    pelvis = scale * theirs[:, hips].mean(1) - ours
    return Motion(axis_angle_from_matrix(local).float(), (pelvis - joints[0]).float(), fps, name)


def _rotations_from_rest(clip: SkeletonClip, rest: Tensor, joints: Tensor) -> dict[str, Tensor]:
    """Return the world rotations of our joints, for a skeleton that rests as a person stands."""
    match, up = clip.match, rest[:, 1]
    rotations = _trunk(clip, [clip.rotations[:, joint] @ rest for joint in match.trunk], joints)
    for side in SIDES:
        swing = torch.eye(3, dtype=torch.float64)
        for start in ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist"):
            name = f"{side}_{start}"
            if name not in match.limbs:
                continue
            joint = match.limbs[name]
            ours = rest @ _our_bone(joints, name)
            if start in _LIMBS:
                theirs = clip.direction(joint, match.limbs[f"{side}_{_LIMBS[start]}"])
                swing = _shortest_rotation(ours, theirs)
            elif start in ("ankle", "collar"):
                swing = torch.eye(3, dtype=torch.float64)
            if start == "ankle" and f"{side}_foot" in match.limbs:
                # Soles are level at rest, however high in the foot its joints are: it is only turned about.
                theirs = clip.direction(joint, match.limbs[f"{side}_foot"])
                swing = _shortest_rotation(
                    *(direction - (direction @ up) * up for direction in (ours, theirs))
                )
                swing = _rotation_unless_same(swing @ ours, theirs) @ swing
            elif start == "wrist" and (theirs := clip.bone(joint)) is not None:
                swing = _rotation_unless_same(swing @ ours, theirs) @ swing
            rotations[name] = clip.rotations[:, joint] @ swing @ rest
    if match.head is not None:
        rotations["head"] = clip.rotations[:, match.head] @ rest
        rotations["neck"] = nearest_rotation(rotations["spine3"] + rotations["head"])
        if match.neck:
            bow = _rotation_unless_same(
                rest @ _our_bone(joints, "neck"), clip.direction(match.neck[0], match.head)
            )
            rotations["neck"] = _mean([clip.rotations[:, joint] @ bow @ rest for joint in match.neck])
    return rotations


def _rotations_from_motion(clip: SkeletonClip, joints: Tensor) -> dict[str, Tensor]:
    """Return the world rotations of our joints, for a skeleton whose rest pose is no person's."""
    match = clip.match
    rotations = _trunk(clip, _trunk_rotations(clip, joints), joints)
    before = rotations["spine3"]
    for joint, after in zip(match.neck, (*match.neck, match.head)[1:], strict=True):
        direction = clip.direction(joint, after)  # pyright: ignore[reportArgumentType]
        before = clip.rotations[:, joint] @ _aligned(
            clip.rotations[:, joint], direction, _our_bone(joints, "neck"), before
        )
        rotations.setdefault("neck", before)
    if match.head is not None:
        rotation = clip.rotations[:, match.head]
        rotations["head"] = rotation @ _aligned(
            rotation, clip.bone(match.head), _our_bone(joints, "head"), before
        )
        rotations.setdefault("neck", nearest_rotation(rotations["spine3"] + rotations["head"]))
    for side in SIDES:
        for start in ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist"):
            name = f"{side}_{start}"
            if name not in match.limbs:
                continue
            joint, parent = match.limbs[name], JOINT_NAMES[PARENTS[_AT[name]]]
            rotation, ours = clip.rotations[:, joint], _our_bone(joints, name)
            before = rotations.get(parent, rotations["spine3"])
            theirs = clip.bone(joint) if start == "wrist" else None
            end = f"{side}_{_ENDS.get(start)}"
            if end in match.limbs:
                theirs = clip.direction(joint, match.limbs[end])
            constant = _aligned(rotation, theirs, ours, before)
            if start in _LIMBS and (hinge := _hinge(clip, side, start)).norm() > _BENT:
                bends = _HINGES["leg" if start in ("hip", "knee") else side]
                constant = _rolled(constant, ours, ours.new_tensor(bends), hinge)
            rotations[name] = rotation @ constant
    return rotations


def _trunk_rotations(clip: SkeletonClip, joints: Tensor) -> list[Tensor]:
    """Return the rotations of a skeleton's trunk joints, legs' to arms', from our rest pose."""
    match = clip.match
    top = (*match.neck, match.head)[0]
    positions = body_joint_positions(match, clip.positions)
    shoulders = positions[:, [_AT["left_shoulder"], _AT["right_shoulder"]]]
    ends = [clip.positions[:, joint] for joint in match.trunk[1:]]
    ends.append(shoulders.mean(1) if top is None else clip.positions[:, top])
    directions = [
        median_direction(clip.rotations[:, joint], end - clip.positions[:, joint])
        for joint, end in zip(match.trunk, ends, strict=True)
    ]
    fractions = torch.stack([direction.norm() for direction in directions]).cumsum(0)
    fractions = [0.0, *(fractions / fractions[-1]).tolist()]
    ours = [_along(joints, end) - _along(joints, start) for start, end in pairwise(fractions)]
    lines = {
        0: ("hip", positions[:, _AT["left_hip"]] - positions[:, _AT["right_hip"]]),
        len(directions) - 1: ("shoulder", shoulders[:, 0] - shoulders[:, 1]),
    }
    rotations = []
    for number, (joint, direction, our_direction) in enumerate(
        zip(match.trunk, directions, ours, strict=True)
    ):
        rotation = clip.rotations[:, joint]
        if number in lines and direction.norm() > 0:
            limb, across = lines[number]
            our_across = joints[_AT[f"left_{limb}"]] - joints[_AT[f"right_{limb}"]]
            constant = (
                _frame(median_direction(rotation, across), direction) @ _frame(our_across, our_direction).T
            )
        else:
            constant = _aligned(rotation, direction, our_direction, rotations[-1])
        rotations.append(rotation @ constant)
    return rotations


def _trunk(clip: SkeletonClip, rotations: list[Tensor], joints: Tensor) -> dict[str, Tensor]:
    """Return the rotations of our pelvis and spine for those of a trunk of any number of joints."""
    between = rotations[1:-1]
    if not between:
        # Without a joint between legs and arms the bend is shared out.
        thirds = [(2 * rotations[0] + rotations[-1]) / 3, (rotations[0] + 2 * rotations[-1]) / 3]
        return {"pelvis": rotations[0], "spine3": rotations[-1]} | {
            f"spine{number}": nearest_rotation(rotation) for number, rotation in enumerate(thirds, 1)
        }
    trunk = clip.match.trunk
    lengths = [float(clip.direction(*pair).norm()) for pair in pairwise(trunk[1:])]
    if len(between) <= 2 or min(lengths) <= 0:
        lengths = [1.0] * len(between)
    ends = torch.tensor([0.0, *lengths], dtype=torch.float64).cumsum(0) / sum(lengths)
    lower, upper = joints[[_AT["spine1"], _AT["spine2"], _AT["spine3"]]].diff(dim=0).norm(dim=1).tolist()
    half = lower / (lower + upper) if len(between) > 2 else 0.5
    spine = {}
    for number, (low, high) in enumerate(((0.0, half), (half, 1.0)), 1):
        shares = (ends[1:].clamp(max=high) - ends[:-1].clamp(min=low)).clamp_min(0)
        spine[f"spine{number}"] = nearest_rotation(torch.einsum("k,k...->...", shares, torch.stack(between)))
    return {"pelvis": rotations[0], "spine3": rotations[-1], **spine}


def _our_bone(joints: Tensor, name: str) -> Float[Tensor, "3"]:
    """Return the rest direction of what begins at a joint of ours."""
    if name == "head":
        return joints.new_tensor([0.0, 1.0, 0.0])
    side, _, joint = name.partition("_")
    if joint == "foot":
        return joints.new_tensor([0.0, 0.0, 1.0])
    end = "head" if name == "neck" else f"{side}_{_ENDS.get(joint, 'middle1')}"
    return normalize(joints[_AT[end]] - joints[_AT[name]], dim=0)


def _along(joints: Tensor, fraction: float) -> Float[Tensor, "3"]:
    """Return the point at a part of the way up our resting spine."""
    points = joints[[_AT[name] for name in ("pelvis", "spine1", "spine2", "spine3", "neck")]]
    lengths = points.diff(dim=0).norm(dim=1)
    rest = fraction * lengths.sum()
    for start, direction, length in zip(points, points.diff(dim=0), lengths, strict=False):
        if rest <= length:
            return start + direction * (rest / length)
        rest = rest - length
    return points[-1]


def _aligned(
    rotations: Float[Tensor, "f 3 3"], theirs: Tensor | None, ours: Tensor, before: Float[Tensor, "f 3 3"]
) -> Float[Tensor, "3 3"]:
    """Return the constant that carries our bone onto theirs and twists least against the joint before."""
    relative = (rotations.mT @ before).mean(0)
    if theirs is None or not theirs.norm() > 0:
        return nearest_rotation(relative)
    axis = normalize(ours, dim=0)
    constant = _shortest_rotation(axis, theirs)
    overlap = relative.T @ constant
    across = torch.linalg.cross(axis.expand(3, 3), torch.eye(3, dtype=axis.dtype), dim=1).T
    angle = torch.atan2((overlap @ across).trace(), overlap.trace() - axis @ overlap @ axis)
    return constant @ matrix_from_axis_angle(angle * axis)


def _hinge(clip: SkeletonClip, side: str, start: str) -> Float[Tensor, "3"]:
    """Return about what a knee or elbow bends, in the axes of one of its bones; short if straight."""
    chain = [clip.match.limbs[f"{side}_{name}"] for name in _CHAINS[start in ("shoulder", "elbow")]]
    upper, lower = (
        normalize(clip.positions[:, end] - clip.positions[:, begin], dim=-1) for begin, end in pairwise(chain)
    )
    rotations = clip.rotations[:, clip.match.limbs[f"{side}_{start}"]]
    return (rotations.mT @ torch.linalg.cross(upper, lower)[..., None])[..., 0].mean(0)


def _rolled(constant: Tensor, bone: Tensor, ours: Tensor, theirs: Tensor) -> Float[Tensor, "3 3"]:
    """Return the constant rolled about our bone until a direction of ours falls on theirs, seen along it."""
    across = normalize(ours - (ours @ bone) * bone, dim=0)
    angle = torch.atan2(theirs @ constant @ torch.linalg.cross(bone, across), theirs @ constant @ across)
    return constant @ matrix_from_axis_angle(angle * bone)


def _frame(across: Float[Tensor, "3"], along: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation whose first column is one direction and whose second is nearest to another."""
    x = normalize(across, dim=0)
    y = normalize(along - (along @ x) * x, dim=0)
    return torch.stack([x, y, torch.linalg.cross(x, y)], 1)


def _snap(direction: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Return the axis of the world that a direction nearly is, else the direction."""
    axis = int(direction.abs().argmax())
    if direction[axis].abs() < _SNAP:
        return direction
    return torch.eye(3, dtype=direction.dtype)[axis] * direction[axis].sign()


def _mean(rotations: Sequence[Tensor]) -> Float[Tensor, "*f 3 3"]:
    return rotations[0] if len(rotations) == 1 else nearest_rotation(torch.stack([*rotations]).mean(0))


def _rotation_unless_same(ours: Float[Tensor, "3"], theirs: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the shortest rotation from one direction to another, none where they mean the same at rest."""
    if normalize(ours, dim=0) @ normalize(theirs, dim=0) > _SAME:
        return torch.eye(3, dtype=torch.float64)
    return _shortest_rotation(ours, theirs)


def _shortest_rotation(source: Float[Tensor, "3"], target: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation matrix without roll that carries one direction to another."""
    axis = torch.linalg.cross(source, target)
    angle = torch.atan2(axis.norm(), source @ target)
    if axis.norm() < 1e-9 * source.norm() * target.norm():
        # Parallel, or opposite: then about any axis across.
        axis = torch.linalg.cross(source, torch.eye(3, dtype=source.dtype)[source.abs().argmin()])
    return matrix_from_axis_angle(normalize(axis, dim=0) * angle)
