"""Bake a motion-capture clip (.bvh, CMU skeleton) into the AMASS .npz that the package embeds.

    python tools/bake_motion.py 01_01.bvh --out dsar/data/embedded_motion/cmu_01_01.npz

The clip moves the embedded body: each joint takes the world rotation of its CMU counterpart, corrected
where the two skeletons' limbs point differently at rest (CMU's legs are splayed by 20 degrees). The hips
follow the clip's, scaled by the length of the legs, and the soles stand on y = 0: a tenth of the frames
may reach lower, as toes do that push off. CMU's clips come from mocap.cs.cmu.edu, created with funding
from NSF EIA-0196217, free to use.
"""

import argparse
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from dsar.body.files import load_body
from dsar.body.model import JOINT_NAMES, Body
from dsar.body.skinning import pose_vertices
from dsar.data.motion import resample, write_motion
from dsar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from dsar.types import Motion

SIDES = (("left", "Left"), ("right", "Right"))
COUNTERPARTS = {
    **{"pelvis": "Hips", "spine1": "LowerBack", "spine2": "Spine", "spine3": "Spine1"},
    **{"neck": "Neck", "head": "Head"},
    **{f"{ours}_hip": f"{theirs}UpLeg" for ours, theirs in SIDES},
    **{f"{ours}_knee": f"{theirs}Leg" for ours, theirs in SIDES},
    **{f"{ours}_ankle": f"{theirs}Foot" for ours, theirs in SIDES},
    **{f"{ours}_foot": f"{theirs}ToeBase" for ours, theirs in SIDES},
    **{f"{ours}_collar": f"{theirs}Shoulder" for ours, theirs in SIDES},
    **{f"{ours}_shoulder": f"{theirs}Arm" for ours, theirs in SIDES},
    **{f"{ours}_elbow": f"{theirs}ForeArm" for ours, theirs in SIDES},
    **{f"{ours}_wrist": f"{theirs}Hand" for ours, theirs in SIDES},
}
"""CMU's joint for each of SMPL-X's 22 body joints."""

CORRECTED = {
    f"{side}_{start}": f"{side}_{end}"
    for side, _ in SIDES
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
}
"""Limbs whose rest directions are matched, joint to joint. Trunk, hands and feet need none: both skeletons
rest upright with level soles and palms down."""


@dataclass
class Skeleton:
    """The hierarchy of a .bvh file."""

    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    offsets: list[list[float]] = field(default_factory=list)
    channels: list[list[str]] = field(default_factory=list)


def main() -> None:
    """Read, retarget, resample, put on the ground, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bvh", type=Path, help="a clip on CMU's skeleton")
    parser.add_argument("--out", type=Path, required=True, help="the .npz to write")
    parser.add_argument("--fps", type=float, default=30.0, help="frames per second to write")
    arguments = parser.parse_args()
    body = load_body()
    skeleton, values, rate = read_bvh(arguments.bvh)
    # Frame 0 is the T-pose that the conversion to .bvh put in front of the recording.
    turns, positions = evaluate(skeleton, values[1:])
    motion = resample(retarget(skeleton, turns, positions, body, rate, arguments.out.stem), arguments.fps)
    lowest = torch.stack([pose_vertices(body, pose)[:, 1].min() for pose in motion])
    ground = torch.quantile(lowest, 0.1)
    motion = Motion(
        motion.rotations,
        motion.translations - ground * torch.tensor([0.0, 1.0, 0.0]),
        motion.fps,
        motion.name,
    )
    write_motion(arguments.out, motion, body)
    levels = torch.quantile(lowest - ground, torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0])).tolist()
    print(f"{arguments.out}: {len(motion)} frames, {arguments.out.stat().st_size / 1e3:.0f} kB")
    print("quartiles of the lowest vertex's height, m:", *(f"{level:.3f}" for level in levels))


def read_bvh(path: Path) -> tuple[Skeleton, np.ndarray, float]:
    """Return the skeleton, the channel values (frames, channels) and the frames per second."""
    hierarchy, motion = path.read_text().split("MOTION")
    skeleton, stack, is_end = Skeleton(), [], False
    for words in map(str.split, hierarchy.splitlines()):
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
    lines = motion.strip().splitlines()
    return skeleton, np.loadtxt(lines[2:]), round(1 / float(lines[1].split()[-1]))


def evaluate(skeleton: Skeleton, values: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Return world rotations (frames, joints, 3, 3) and the root's position (frames, 3) in file units."""
    axes = dict(zip("XYZ", torch.eye(3, dtype=torch.float64), strict=True))
    columns = torch.from_numpy(values).split([len(channels) for channels in skeleton.channels], dim=1)
    turns: list[torch.Tensor] = []
    for parent, channels, column in zip(skeleton.parents, skeleton.channels, columns, strict=True):
        turn = turns[parent] if parent >= 0 else torch.eye(3, dtype=torch.float64).expand(len(values), 3, 3)
        for channel, value in zip(channels, column.T, strict=True):
            if channel.endswith("rotation"):
                turn = turn @ matrix_from_axis_angle(value.deg2rad()[:, None] * axes[channel[0]])
        turns.append(turn)
    order = [skeleton.channels[0].index(f"{axis}position") for axis in "XYZ"]
    return torch.stack(turns, 1), columns[0][:, order]


def retarget(
    skeleton: Skeleton, turns: torch.Tensor, positions: torch.Tensor, body: Body, fps: float, name: str
) -> Motion:
    """Return the motion of our body whose limbs point where the clip's do and whose hips are there too."""
    joints = body.joints.double()
    offset = dict(zip(skeleton.names, torch.tensor(skeleton.offsets, dtype=torch.float64), strict=True))
    index = {name: i for i, name in enumerate(JOINT_NAMES)}
    world = torch.eye(3, dtype=torch.float64).repeat(len(turns), len(JOINT_NAMES), 1, 1)
    for ours, theirs in COUNTERPARTS.items():
        turn = turns[:, skeleton.names.index(theirs)]
        if end := CORRECTED.get(ours):
            turn = turn @ shortest_rotation(
                joints[index[end]] - joints[index[ours]], offset[COUNTERPARTS[end]]
            )
        world[:, index[ours]] = turn
    local = torch.stack([world[:, max(p, 0)].mT @ world[:, j] for j, p in enumerate(body.parents)], 1)
    local[:, 0] = world[:, 0]
    local[:, len(COUNTERPARTS) :] = torch.eye(3, dtype=torch.float64)

    legs = [COUNTERPARTS[f"{side}_{joint}"] for side, _ in SIDES for joint in ("knee", "ankle")]
    ours_leg = sum(
        (joints[j] - joints[body.parents[j]]).norm() for j in (index["left_knee"], index["left_ankle"])
    )
    scale = 2 * ours_leg / sum(offset[joint].norm() for joint in legs)
    their_hips = positions + turns[:, 0] @ (offset["LeftUpLeg"] + offset["RightUpLeg"]) / 2
    our_hips = (joints[index["left_hip"]] + joints[index["right_hip"]]) / 2 - joints[0]
    pelvis = scale * their_hips - world[:, 0] @ our_hips
    return Motion(axis_angle_from_matrix(local).float(), (pelvis - joints[0]).float(), fps, name)


def shortest_rotation(source: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the rotation matrix without roll that carries one direction to another."""
    axis = torch.linalg.cross(source, target)
    angle = torch.atan2(axis.norm(), source @ target)
    return matrix_from_axis_angle(torch.nn.functional.normalize(axis, dim=0) * angle)


if __name__ == "__main__":
    main()
