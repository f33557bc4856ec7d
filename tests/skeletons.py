"""One motion of our body written as the .bvh of other makers: names, joints, rest poses, units, axes."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dsar.body.model import JOINT_NAMES, PARENTS
from dsar.body.skinning import forward_kinematics
from dsar.types import Body, Motion

BODY = JOINT_NAMES[:22]
_CENTRE: tuple[str, ...] = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_ARM, _LEG = ("collar", "shoulder", "elbow", "wrist"), ("hip", "knee", "ankle", "foot")


@dataclass(frozen=True)
class Layout:
    """How a maker's files hold a person."""

    centre: tuple[str, ...]
    """Names of pelvis, spine1, spine2, spine3, neck and head; empty where there is no such joint."""
    arm: tuple[str, ...]
    """Names of collar, shoulder, elbow and wrist; {} is the side."""
    leg: tuple[str, ...]
    """Names of hip, knee, ankle and toes."""
    sides: tuple[str, str] = ("Left", "Right")
    prefix: str = ""
    rest: str = "T"
    """T, A, or line: every bone along +X of its own axes."""
    turned: tuple[float, ...] = (0.0, 0.0, 0.0)
    """How the rest pose is turned in the world, degrees about X, Y, Z."""
    world: tuple[float, ...] = (0.0, 0.0, 0.0)
    """How the world is turned."""
    unit: float = 0.01
    """Metres of a unit."""
    order: str = "ZYX"
    extra: dict[str, tuple[str, str, float]] = field(default_factory=dict)
    """More joints: by name, our joints between which it is, and the part of the way."""
    root: str = ""
    """A joint above the hips, on the ground."""
    positions: bool = False
    """Position channels on every joint."""
    fingers: bool = False


MIXAMO = Layout(
    ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"),
    ("{}Shoulder", "{}Arm", "{}ForeArm", "{}Hand"),
    ("{}UpLeg", "{}Leg", "{}Foot", "{}ToeBase"),
    prefix="mixamorig:",
    order="XYZ",
    fingers=True,
)
CMU = Layout(
    ("Hips", "LowerBack", "Spine", "Spine1", "Neck", "Head"),
    ("{}Shoulder", "{}Arm", "{}ForeArm", "{}Hand"),
    ("{}UpLeg", "{}Leg", "{}Foot", "{}ToeBase"),
    unit=0.056444,
    extra={"LHipJoint": ("pelvis", "left_hip", 0.0), "RHipJoint": ("pelvis", "right_hip", 0.0)},
)
LAFAN1 = Layout(
    ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"),
    ("{}Shoulder", "{}Arm", "{}ForeArm", "{}Hand"),
    ("{}UpLeg", "{}Leg", "{}Foot", "{}Toe"),
    rest="line",
)
ROKOKO = Layout(
    ("Hips", "Spine1", "Spine2", "Spine4", "Neck", "Head"),
    ("{}Shoulder", "{}Arm", "{}ForeArm", "{}Hand"),
    ("{}Thigh", "{}Shin", "{}Foot", "{}Toe"),
    rest="A",
    order="YXZ",
    turned=(0.0, 180.0, 0.0),
    extra={"Spine3": ("spine2", "spine3", 0.5)},
    root="Root",
    positions=True,
    fingers=True,
)
XSENS = Layout(
    ("Hips", "Chest", "Chest3", "Chest4", "Neck", "Head"),
    ("{}Collar", "{}Shoulder", "{}Elbow", "{}Wrist"),
    ("{}Hip", "{}Knee", "{}Ankle", "{}Toe"),
    order="YZX",
    world=(90.0, 0.0, 0.0),
    turned=(90.0, 0.0, 0.0),
    unit=0.0254,
    extra={"Chest2": ("spine1", "spine2", 0.5)},
)
LAYOUTS = {"mixamo": MIXAMO, "cmu": CMU, "lafan1": LAFAN1, "rokoko": ROKOKO, "xsens": XSENS}


@dataclass
class _Joint:
    name: str
    parent: int
    turn: np.ndarray
    """World rotations that carry our rest pose, by frame."""
    place: np.ndarray
    """World places, metres."""
    rest: np.ndarray
    """Place in our rest pose."""
    axes: np.ndarray
    """What carries our rest pose's directions into the file's."""


def world_joints(body: Body, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Return the world rotations and places of all joints."""
    transforms = forward_kinematics(body, motion.rotations, motion.translations)
    places = (transforms[..., :3, :3] @ body.joints[:, :, None])[..., 0] + transforms[..., :3, 3]
    return transforms[..., :3, :3].double().numpy(), places.double().numpy()


def write_layout(path: Path, layout: Layout, body: Body, motion: Motion) -> Path:
    """Write a motion as a maker would."""
    joints = _joints(layout, body, motion)
    world = Rotation.from_euler("xyz", layout.world, degrees=True).as_matrix()
    children = {
        index: [j for j, each in enumerate(joints) if each.parent == index] for index in range(len(joints))
    }
    columns: list[np.ndarray] = []

    def lines_of(index: int, depth: int) -> list[str]:
        joint, pad = joints[index], "  " * depth
        parent = joints[joint.parent] if index else None
        offset = parent.axes @ (joint.rest - parent.rest) if parent else np.zeros(3)
        file_turn = world @ joint.turn @ joint.axes.T
        above = world @ parent.turn @ parent.axes.T if parent else np.eye(3)[None]
        local = above.transpose(0, 2, 1) @ file_turn
        euler = Rotation.from_matrix(local).as_euler(layout.order, degrees=True)
        place = joint.place @ world.T if parent is None else np.tile(offset, (len(local), 1))
        if parent is not None and parent.name == layout.prefix + layout.root:
            place = (above.transpose(0, 2, 1) @ ((joint.place - parent.place) @ world.T)[..., None])[..., 0]
        has_place = parent is None or layout.positions
        rotations = " ".join(f"{axis}rotation" for axis in layout.order)
        names = f"6 Xposition Yposition Zposition {rotations}" if has_place else f"3 {rotations}"
        columns.extend([place / layout.unit, euler] if has_place else [euler])
        found = [f"{pad}{'JOINT' if depth else 'ROOT'} {joint.name}", pad + "{"]
        found += [
            f"{pad}  OFFSET {' '.join(f'{x:.6f}' for x in offset / layout.unit)}",
            f"{pad}  CHANNELS {names}",
        ]
        for child in children[index]:
            found += lines_of(child, depth + 1)
        if not children[index]:
            bone = (
                np.array([0.0, 0.2, 0.0])
                if joint.name.endswith("Head")
                else joint.rest - joints[joint.parent].rest
            )
            tip = joint.axes @ bone / layout.unit / 2
            found += [
                f"{pad}  End Site",
                pad + "  {",
                f"{pad}    OFFSET {' '.join(f'{x:.6f}' for x in tip)}",
                pad + "  }",
            ]
        return [*found, pad + "}"]

    lines = [
        "HIERARCHY",
        *lines_of(0, 0),
        "MOTION",
        f"Frames: {len(motion)}",
        f"Frame Time: {1 / motion.fps:.7f}",
    ]
    values = np.concatenate(columns, 1)
    lines += [" ".join(f"{value:.6f}" for value in row) for row in values]
    path.write_text("\n".join(lines) + "\n")
    return path


def _joints(layout: Layout, body: Body, motion: Motion) -> list[_Joint]:
    turns, places = world_joints(body, motion)
    rest = body.joints.double().numpy()
    names: dict[str, str] = dict(zip(_CENTRE, layout.centre, strict=True))
    for side, word in zip(("left", "right"), layout.sides, strict=True):
        for ours, theirs in zip((*_ARM, *_LEG), (*layout.arm, *layout.leg), strict=True):
            names[f"{side}_{ours}"] = theirs.format(word)
        if layout.fingers:
            for finger in ("Index", "Thumb"):
                for number in (1, 2, 3):
                    names[f"{side}_{finger.lower()}{number}"] = f"{word}Hand{finger}{number}"
    joints: list[_Joint] = []
    if layout.root:
        ground = places[:, 0] * (1, 0, 1)
        still = np.tile(np.eye(3), (len(motion), 1, 1))
        joints.append(
            _Joint(
                layout.prefix + layout.root, -1, still, ground, rest[0] * (1, 0, 1), _axes(layout, 0, rest)
            )
        )
    index: dict[str, int] = {}
    for number, ours in enumerate(JOINT_NAMES):
        parent = index.get(JOINT_NAMES[PARENTS[number]], -1) if number else len(joints) - 1
        if not names.get(ours):
            index[ours] = parent
            continue
        for extra, (start, end, part) in layout.extra.items():
            if end == ours:
                a = JOINT_NAMES.index(start)
                where, there = (
                    (1 - part) * of[..., a, :] + part * of[..., number, :] for of in (places, rest)
                )
                joints.append(
                    _Joint(layout.prefix + extra, parent, turns[:, a], where, there, _axes(layout, a, rest))
                )
                parent = len(joints) - 1
        index[ours] = len(joints)
        joints.append(
            _Joint(
                layout.prefix + names[ours],
                parent,
                turns[:, number],
                places[:, number],
                rest[number],
                _axes(layout, number, rest),
            )
        )
    return joints


def _axes(layout: Layout, joint: int, rest: np.ndarray) -> np.ndarray:
    """What carries directions of our rest pose to those of the file's."""
    name = JOINT_NAMES[joint]
    turned = Rotation.from_euler("xyz", layout.turned, degrees=True).as_matrix()
    if layout.rest == "line":
        child = next((j for j, parent in enumerate(PARENTS) if parent == joint and j not in (1, 2)), None)
        bone = rest[child] - rest[joint] if child is not None else rest[joint] - rest[PARENTS[joint]]
        bone = bone if bone.any() else np.array([0.0, 1.0, 0.0])
        x = bone / np.linalg.norm(bone)
        z = np.cross(x, [0.3, 0.2, 1.0])
        z /= np.linalg.norm(z)
        return np.stack([x, np.cross(z, x), z])
    arm = name.split("_")[-1].rstrip("123") not in ("hip", "knee", "ankle", "foot", "collar")
    if layout.rest == "A" and "_" in name and arm:
        down = 45.0 if name.startswith("right") else -45.0
        return turned @ Rotation.from_euler("z", down, degrees=True).as_matrix()
    return turned
