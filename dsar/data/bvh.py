"""Motion capture in .bvh files, retargeted from CMU's skeleton to our body.

Each joint takes the world rotation of its counterpart, corrected where the two skeletons' limbs point
differently at rest (CMU's legs are splayed by 20 degrees). The hips follow the clip's, scaled by the length
of the legs: the file's unit does not matter. Y is up in both.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.body.model import JOINT_NAMES
from dsar.errors import MotionError
from dsar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from dsar.types import Body, Motion

_SIDES = (("left", "Left"), ("right", "Right"))
COUNTERPARTS = {
    **{"pelvis": "Hips", "spine1": "LowerBack", "spine2": "Spine", "spine3": "Spine1"},
    **{"neck": "Neck", "head": "Head"},
    **{f"{ours}_hip": f"{theirs}UpLeg" for ours, theirs in _SIDES},
    **{f"{ours}_knee": f"{theirs}Leg" for ours, theirs in _SIDES},
    **{f"{ours}_ankle": f"{theirs}Foot" for ours, theirs in _SIDES},
    **{f"{ours}_foot": f"{theirs}ToeBase" for ours, theirs in _SIDES},
    **{f"{ours}_collar": f"{theirs}Shoulder" for ours, theirs in _SIDES},
    **{f"{ours}_shoulder": f"{theirs}Arm" for ours, theirs in _SIDES},
    **{f"{ours}_elbow": f"{theirs}ForeArm" for ours, theirs in _SIDES},
    **{f"{ours}_wrist": f"{theirs}Hand" for ours, theirs in _SIDES},
}
"""CMU's joint for each of SMPL-X's 22 body joints."""
# Limbs whose rest directions are matched, joint to joint. Trunk, hands and feet need none: both skeletons
# rest upright with level soles and palms down.
_CORRECTED = {
    f"{side}_{start}": f"{side}_{end}"
    for side, _ in _SIDES
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
}


@dataclass
class Skeleton:
    """The hierarchy of a .bvh file."""

    names: list[str] = field(default_factory=list)
    """Joints, each after its parent."""
    parents: list[int] = field(default_factory=list)
    """Their parents; -1 at the root."""
    offsets: list[list[float]] = field(default_factory=list)
    """Their places at rest relative to their parents, in the file's unit."""
    channels: list[list[str]] = field(default_factory=list)
    """What the columns of a frame say of them."""


def read_bvh(path: Path, body: Body) -> Motion:
    """Return the motion of a clip on CMU's skeleton for a body in the Y-up world, float32.

    A first frame without any rotation is left out: it is the T-pose that CMU's conversion to .bvh put in
    front of the recording.

    Raises:
        MotionError: the file is missing or malformed, has no frames, or lacks a joint.
    """
    skeleton, values, fps = parse_bvh(path)
    missing = sorted(set(COUNTERPARTS.values()) - set(skeleton.names))
    if missing:
        raise MotionError(
            f"motion file {path}: lacks the joints {', '.join(missing)}; it has {', '.join(skeleton.names)}; "
            "expected CMU's names, rename its joints"
        )
    turned = [channel.endswith("rotation") for channels in skeleton.channels for channel in channels]
    if len(values) > 1 and not values[0, turned].any():
        values = values[1:]
    return retarget(skeleton, values, body, fps, path.stem)


def parse_bvh(path: Path) -> tuple[Skeleton, Float[np.ndarray, "f c"], float]:
    """Return the skeleton, the channels' values (degrees, the file's unit) and the frames per second.

    Raises:
        MotionError: the file is missing or malformed, or has no frames.
    """
    if not path.is_file():
        raise MotionError(f"motion file {path}: no such file")
    try:
        hierarchy, separator, motion = path.read_text().partition("MOTION")
        if not separator:
            raise ValueError("it has no MOTION")
        skeleton = _parse_hierarchy(hierarchy)
        lines = motion.split("\n")
        lines = [line for line in lines if line.strip()]
        count, seconds = int(lines[0].split()[-1]), float(lines[1].split()[-1])
        rows = [[float(number) for number in line.split()] for line in lines[2:]]
    except (OSError, UnicodeDecodeError, ValueError, IndexError) as error:
        raise MotionError(f"motion file {path}: cannot be read as .bvh ({error})") from error
    columns = sum(map(len, skeleton.channels))
    wrong = [number for number, row in enumerate(rows) if len(row) != columns]
    if wrong:
        raise MotionError(
            f"motion file {path}: frame {wrong[0]} has {len(rows[wrong[0]])} numbers, expected {columns}"
        )
    if len(rows) != count or not rows:
        raise MotionError(f"motion file {path}: has {len(rows)} frames, expected {count} and at least one")
    values = np.array(rows)
    bad = np.argwhere(~np.isfinite(values))
    if len(bad) or not 0 < seconds < np.inf:
        where = f"frame {bad[0][0]}" if len(bad) else f"the frame time {seconds}"
        raise MotionError(f"motion file {path}: {where} is not a finite number above what can be; cut it out")
    # Files give the time of a frame in few digits: .0083333 is 120 a second.
    fps = 1 / seconds
    return skeleton, values, float(round(fps)) if abs(fps - round(fps)) < 1e-4 * fps else fps


def _parse_hierarchy(text: str) -> Skeleton:
    skeleton, stack, is_end = Skeleton(), [], False
    for words in map(str.split, text.splitlines()):
        match words:
            case ["ROOT" | "JOINT", name]:
                skeleton.names.append(name)
                skeleton.parents.append(stack[-1] if stack else -1)
            case ["End", "Site"]:
                is_end = True
            case ["{"]:
                stack.append(len(skeleton.names) - 1)
            case ["}"]:
                stack.pop()
                is_end = False
            case ["OFFSET", *numbers] if not is_end:
                skeleton.offsets.append([float(number) for number in numbers])
            case ["CHANNELS", _, *channels]:
                skeleton.channels.append(channels)
    counts = {len(skeleton.names), len(skeleton.offsets), len(skeleton.channels)}
    if len(counts) != 1 or not skeleton.names or any(len(offset) != 3 for offset in skeleton.offsets):
        raise ValueError("a joint lacks its name, its OFFSET of three numbers or its CHANNELS")
    if not {"Xposition", "Yposition", "Zposition"} <= set(skeleton.channels[0]):
        raise ValueError("its root has no position")
    return skeleton


def pose_skeleton(
    skeleton: Skeleton, values: Float[np.ndarray, "f c"]
) -> tuple[Float[Tensor, "f j 3 3"], Float[Tensor, "f j 3"]]:
    """Return the rotation of every joint in the world, by frame, and its place in the file's unit."""
    axes = dict(zip("XYZ", torch.eye(3, dtype=torch.float64), strict=True))
    columns = torch.from_numpy(values).split([len(channels) for channels in skeleton.channels], dim=1)
    turns: list[Tensor] = []
    order = [skeleton.channels[0].index(f"{axis}position") for axis in "XYZ"]
    places = [columns[0][:, order]]
    for parent, channels, column in zip(skeleton.parents, skeleton.channels, columns, strict=True):
        turn = turns[parent] if parent >= 0 else torch.eye(3, dtype=torch.float64).expand(len(values), 3, 3)
        for channel, value in zip(channels, column.T, strict=True):
            if channel.endswith("rotation"):
                turn = turn @ matrix_from_axis_angle(value.deg2rad()[:, None] * axes[channel[0]])
        turns.append(turn)
    for parent, offset in list(zip(skeleton.parents, skeleton.offsets, strict=True))[1:]:
        places.append(places[parent] + turns[parent] @ torch.tensor(offset, dtype=torch.float64))
    return torch.stack(turns, 1), torch.stack(places, 1)


def retarget(
    skeleton: Skeleton, values: Float[np.ndarray, "f c"], body: Body, fps: float, name: str
) -> Motion:
    """Return the motion of a body whose limbs point where the clip's do and whose hips are there too."""
    (turns, places), joints = pose_skeleton(skeleton, values), body.joints.double()
    offset = dict(zip(skeleton.names, torch.tensor(skeleton.offsets, dtype=torch.float64), strict=True))
    index = {name: i for i, name in enumerate(JOINT_NAMES)}
    world = torch.eye(3, dtype=torch.float64).repeat(len(turns), len(JOINT_NAMES), 1, 1)
    for ours, theirs in COUNTERPARTS.items():
        turn = turns[:, skeleton.names.index(theirs)]
        if end := _CORRECTED.get(ours):
            limb = joints[index[end]] - joints[index[ours]]
            turn = turn @ _shortest_rotation(limb, offset[COUNTERPARTS[end]])
        world[:, index[ours]] = turn
    local = torch.stack([world[:, max(p, 0)].mT @ world[:, j] for j, p in enumerate(body.parents)], 1)
    local[:, 0] = world[:, 0]
    local[:, len(COUNTERPARTS) :] = torch.eye(3, dtype=torch.float64)

    legs = [COUNTERPARTS[f"{side}_{joint}"] for side, _ in _SIDES for joint in ("knee", "ankle")]
    ends = [index["left_knee"], index["left_ankle"]]
    scale = (
        2
        * sum((joints[end] - joints[body.parents[end]]).norm() for end in ends)
        / sum(offset[leg].norm() for leg in legs)
    )
    their_hips = places[:, [skeleton.names.index(f"{side}UpLeg") for _, side in _SIDES]].mean(1)
    our_hips = (joints[index["left_hip"]] + joints[index["right_hip"]]) / 2 - joints[0]
    pelvis = scale * their_hips - world[:, 0] @ our_hips
    return Motion(axis_angle_from_matrix(local).float(), (pelvis - joints[0]).float(), fps, name)


def _shortest_rotation(source: Float[Tensor, "3"], target: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation matrix without roll that carries one direction to another."""
    axis = torch.linalg.cross(source, target)
    angle = torch.atan2(axis.norm(), source @ target)
    return matrix_from_axis_angle(torch.nn.functional.normalize(axis, dim=0) * angle)
