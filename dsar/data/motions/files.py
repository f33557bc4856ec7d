"""Motion files: AMASS and SMPL-X .npz and .bvh to our `Motion`, .npz back, and changes of frame rate.

A `Motion` has Y up and SMPL-X's 55 joints; files have any axis up and .bvh any skeleton of a person. Shape
coefficients are not read: the avatar moves with its own shape.
"""

import dataclasses
import logging
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.atomic_files import atomic_write
from dsar.data.motions.bvh import Skeleton, pose_skeleton, read_bvh
from dsar.data.motions.joint_matching import JointMatch, match_joints
from dsar.data.motions.kinematics import trace_joints
from dsar.data.motions.retargeting import (
    SkeletonClip,
    body_joint_positions,
    bone_offsets,
    find_standing_rest,
    leg_length,
    retarget,
)
from dsar.data.motions.smplx_npz import read_arrays, read_poses, read_rate
from dsar.data.motions.up_axis import Up, UpAxis, detect_up_axis, rotation_to_y_up
from dsar.errors import MotionError
from dsar.geometry.frame_rates import exact_rate, same_rate
from dsar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from dsar.types import Body, Motion

EMBEDDED_MOTIONS = Path(__file__).parents[1] / "embedded_motion"
"""Clips that come with the package, from the CMU motion capture database (mocap.cs.cmu.edu)."""

_HINTS = dict.fromkeys(
    (".pkl", ".pt", ".pth", ".npy"),
    "save its arrays as .npz: poses (frames, 165 axis-angles), trans (frames, 3), mocap_frame_rate",
) | dict.fromkeys((".fbx", ".c3d", ".glb", ".gltf", ".usd", ".usda", ".usdc"), "export it as .bvh")
LOGGER = logging.getLogger(__name__)


def read_motion(
    path: Path, body: Body, *, up: Up | None = None, fps: float | None = None, level: int = logging.INFO
) -> Motion:
    """Return the motion of a file in the Y-up world, float32, and log what the file was taken for.

    Joints that the file lacks stay at rest.

    Args:
        path: an AMASS, SMPL-X, SMPL-H or SMPL .npz with `poses` (or its parts), `trans` and a frame rate,
            radians, metres; or a .bvh of a person's skeleton in any rest pose and unit (docs/motions.md).
        body: the body that will move: turning the world turns it about its pelvis.
        up: which axis is up in the file; None: found from the motion.
        fps: the file's frames per second, where it says none or a wrong one.
        level: at which it is logged what a .npz was taken for; a warning where that is doubtful.

    Raises:
        MotionError: the file is missing, unreadable, incomplete, empty, not finite or no person's.
    """
    if fps is not None and not 0 < fps < float("inf"):
        raise MotionError(f"motion file {path}: --motion-fps {fps:g}, expected frames per second above 0")
    if path.is_dir():
        raise MotionError(f"motion file {path}: expected a file, found a folder")
    kind = path.suffix.lower()
    if kind == ".bvh":
        return _read_bvh(path, body, up, fps)
    if kind != ".npz":
        hint = f"; {_HINTS[kind]}" if kind in _HINTS else ""
        raise MotionError(
            f"motion file {path}: expected an AMASS or SMPL-X .npz or a .bvh, found {path.suffix!r}{hint}"
        )
    arrays = read_arrays(path)
    rotations, translations = read_poses(path, arrays)
    filed = Motion(rotations, translations, fps or read_rate(path, arrays), path.stem)
    up_axis = _told_up_axis(up) or detect_up_axis(trace_joints(body, filed).positions, "z")
    _log_interpretation(path, up_axis, f"{filed.fps:g} fps", level)
    return filed if up_axis.axis == "y" else rotate_motion(filed, body, rotation_to_y_up(up_axis.axis))


def _read_bvh(path: Path, body: Body, up: Up | None, fps: float | None) -> Motion:
    """Return the motion of a .bvh on our body."""
    bvh = read_bvh(path, fps)
    skeleton = bvh.skeleton
    rotations, positions = pose_skeleton(skeleton, bvh.values)
    bones = bone_offsets(rotations, positions, skeleton.parents)
    match = _match_person(path, skeleton, bones, positions)
    joints = body_joint_positions(match, positions)
    metres = float(leg_length(body.joints) / leg_length(joints).median())
    up_axis = _told_up_axis(up) or detect_up_axis(metres * joints, "y")
    rest = find_standing_rest(match, bones, skeleton.parents)
    rotation = rotation_to_y_up(up_axis.axis).double()
    tips = {joint: torch.tensor(tip, dtype=torch.float64) for joint, tip in skeleton.tips.items()}
    clip = SkeletonClip(rotation @ rotations, positions @ rotation.T, tuple(skeleton.parents), tips, match)
    rests = "in no person's pose, so its joints are aligned by how they move"
    if rest is not None:
        rests = "standing" if torch.equal(rest, torch.eye(3).to(rest)) else "standing, turned"
    _log_interpretation(
        path,
        up_axis,
        f"{len(skeleton.names)} joints by their {match.matched_by}, rest {rests}, "
        f"1 unit = {metres:.3g} m (legs), {bvh.fps:.6g} fps",
    )
    return retarget(clip, rest, body, bvh.fps, path.stem)


def _match_person(path: Path, skeleton: Skeleton, bones: Tensor, positions: Tensor) -> JointMatch:
    """Return the person in a skeleton, or raise."""
    if not bones.any():
        raise MotionError(
            f"motion file {path}: all offsets are zero, so the file has no bones; export it with its skeleton"
        )
    match = match_joints(skeleton.names, skeleton.parents, bones, positions)
    if isinstance(match, list):
        raise MotionError(
            f"motion file {path}: lacks the joints {', '.join(match)}; it has {', '.join(skeleton.names)}; "
            "expected the names of CMU, Mixamo, LAFAN1, Rokoko or Xsens, or a person's shape; rename them"
        )
    joints = body_joint_positions(match, positions)
    if not leg_length(joints).median() > 0:
        raise MotionError(f"motion file {path}: its legs have no length; export it with its skeleton")
    return match


def _told_up_axis(up: Up | None) -> UpAxis | None:
    return UpAxis(up, "told") if up else None


def _log_interpretation(path: Path, up: UpAxis, rest: str, level: int = logging.INFO) -> None:
    """Log what a file was taken for, in one line: a warning where that is doubtful."""
    doubt = "" if up.certain else f"; if that is wrong, say --up {'z' if up.axis == 'y' else 'y'}"
    LOGGER.log(
        level if up.certain else logging.WARNING,
        "%s: %s up (%s%s), %s",
        path.name,
        up.axis.upper(),
        up.reason,
        doubt,
        rest,
    )


def write_motion(path: Path, motion: Motion, body: Body) -> None:
    """Write a motion as AMASS does for SMPL-X (Z up), so that other tools read it too.

    Args:
        path: the .npz file; replaced whole or not at all.
        motion: in the Y-up world.
        body: the body that moves.
    """
    z_up = rotate_motion(motion, body, rotation_to_y_up("z").T)
    with atomic_write(path) as draft, draft.open("wb") as file:
        np.savez_compressed(
            file,
            poses=z_up.rotations.flatten(1).numpy(),
            trans=z_up.translations.numpy(),
            betas=np.zeros(16, np.float32),
            gender=np.array("neutral"),
            surface_model_type=np.array("smplx"),
            mocap_frame_rate=np.array(motion.fps),
        )


def rotate_motion(motion: Motion, body: Body, rotation: Float[Tensor, "3 3"]) -> Motion:
    """Return a motion whose posed vertices are the given motion's, turned about the world's origin."""
    rotation = rotation.to(motion.rotations)
    pelvis = body.joints[0].to(motion.translations)
    roots = axis_angle_from_matrix(rotation @ matrix_from_axis_angle(motion.rotations[:, :1]))
    return dataclasses.replace(
        motion,
        rotations=torch.cat([roots, motion.rotations[:, 1:]], 1),
        translations=(motion.translations + pelvis) @ rotation.T - pelvis,
    )


def resample(motion: Motion, fps: float) -> Motion:
    """Return a motion at another frame rate, from its first frame to at most its last.

    Rotations go from key to key at constant angular velocity (slerp), translations in a line. A rate that
    means the same (`same_rate`) changes no frame.
    """
    if not 0 < fps < float("inf"):
        raise MotionError(f"motion {motion.name}: cannot be resampled to {fps} frames per second")
    if same_rate(motion.fps, fps):
        return dataclasses.replace(motion, fps=fps)
    last, step = len(motion) - 1, float(exact_rate(motion.fps) / exact_rate(fps))
    # A millionth of a frame forgives the rounding of e.g. 30 / 23.976.
    times = torch.arange(int(last / step + 1e-6) + 1, dtype=torch.float64) * step
    before = times.floor().long().clamp(max=last)
    after = (before + 1).clamp(max=last)
    part = (times - before).to(motion.rotations)[:, None]
    start, end = (matrix_from_axis_angle(motion.rotations[frames]) for frames in (before, after))
    change = axis_angle_from_matrix(start.mT @ end) * part[..., None]
    rotations = axis_angle_from_matrix(start @ matrix_from_axis_angle(change))
    translations = torch.lerp(motion.translations[before], motion.translations[after], part)
    return dataclasses.replace(motion, rotations=rotations, translations=translations, fps=fps)
