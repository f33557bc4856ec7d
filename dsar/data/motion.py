"""Motion files: AMASS and SMPL-X .npz to our `Motion` and back, and changes of frame rate.

The files have Z up and the axis-angles of SMPL-X, SMPL-H or SMPL; a `Motion` has Y up and SMPL-X's 55
joints. Their shape coefficients are not read: the avatar moves with its own shape.
"""

import dataclasses
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.body.model import FACE_JOINTS, JOINT_NAMES, Body
from dsar.errors import MotionError
from dsar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from dsar.types import Motion

EMBEDDED_MOTIONS = Path(__file__).parent / "embedded_motion"
"""Clips that come with the package, from the CMU motion capture database (mocap.cs.cmu.edu)."""

_Y_UP_FROM_Z_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
_BODY_JOINTS, _HANDS = range(FACE_JOINTS.start), range(FACE_JOINTS.stop, len(JOINT_NAMES))
# Joints that the columns of `poses` belong to, by their number: SMPL-X, SMPL-H, SMPL (whose last two
# joints, the hands as lumps, SMPL-X has not), and SMPL-X's body alone.
_JOINTS_OF_COLUMNS = {
    165: [*range(len(JOINT_NAMES))],
    156: [*_BODY_JOINTS, *_HANDS],
    72: [*_BODY_JOINTS],
    66: [*_BODY_JOINTS],
}
# Joints of the keys that stand for `poses` in files that split it; AMASS's names, then SMPL-X's.
_JOINTS_OF_KEY = {
    "root_orient": _BODY_JOINTS[:1],
    "pose_body": _BODY_JOINTS[1:],
    "pose_jaw": FACE_JOINTS[:1],
    "pose_eye": FACE_JOINTS[1:],
    "pose_hand": _HANDS,
    "global_orient": _BODY_JOINTS[:1],
    "body_pose": _BODY_JOINTS[1:],
    "jaw_pose": FACE_JOINTS[:1],
    "leye_pose": FACE_JOINTS[1:2],
    "reye_pose": FACE_JOINTS[2:],
    "left_hand_pose": _HANDS[:15],
    "right_hand_pose": _HANDS[15:],
}
_ROOT_KEYS, _BODY_KEYS = ("root_orient", "global_orient"), ("pose_body", "body_pose")
_TRANSLATION_KEYS = ("trans", "transl")
_RATE_KEYS = ("mocap_frame_rate", "mocap_framerate", "fps")


def read_motion(path: Path, body: Body) -> Motion:
    """Return the motion of an AMASS or SMPL-X .npz file in the Y-up world, float32.

    Joints that the file lacks stay at rest.

    Args:
        path: a file with `poses` (or its parts), `trans` and a frame rate; Z up, radians, metres.
        body: the body that will move: turning the world turns it about its pelvis.

    Raises:
        MotionError: the file is missing, unreadable, incomplete, empty or not finite.
    """
    arrays = _read_arrays(path)
    rotations = _read_rotations(path, arrays)
    translations = arrays[_one_key(path, arrays, _TRANSLATION_KEYS)]
    if translations.shape != (len(rotations), 3):
        expected = (len(rotations), 3)
        raise MotionError(f"motion file {path}: trans has shape {translations.shape}, expected {expected}")
    rate = arrays[_one_key(path, arrays, _RATE_KEYS)]
    if rate.size != 1 or not rate.item() > 0:
        raise MotionError(f"motion file {path}: the frame rate is {rate}, expected one number above 0")
    z_up = Motion(
        torch.from_numpy(rotations).float(), torch.from_numpy(translations).float(), rate.item(), path.stem
    )
    return turn_motion(z_up, body, torch.tensor(_Y_UP_FROM_Z_UP))


def write_motion(path: Path, motion: Motion, body: Body) -> None:
    """Write a motion as AMASS does for SMPL-X (Z up), so that other tools read it too.

    Args:
        path: the .npz file; replaced whole or not at all.
        motion: in the Y-up world.
        body: the body that moves.
    """
    z_up = turn_motion(motion, body, torch.tensor(_Y_UP_FROM_Z_UP).T)
    temporary = path.with_name(f".{path.stem}.tmp.npz")
    np.savez_compressed(
        temporary,
        poses=z_up.rotations.flatten(1).numpy(),
        trans=z_up.translations.numpy(),
        betas=np.zeros(16, np.float32),
        gender=np.array("neutral"),
        surface_model_type=np.array("smplx"),
        mocap_frame_rate=np.array(motion.fps),
    )
    os.replace(temporary, path)


def turn_motion(motion: Motion, body: Body, rotation: Float[Tensor, "3 3"]) -> Motion:
    """Return a motion whose posed vertices are the given motion's, turned about the world's origin."""
    turn = rotation.to(motion.rotations)
    pelvis = body.joints[0].to(motion.translations)
    roots = axis_angle_from_matrix(turn @ matrix_from_axis_angle(motion.rotations[:, :1]))
    return dataclasses.replace(
        motion,
        rotations=torch.cat([roots, motion.rotations[:, 1:]], 1),
        translations=(motion.translations + pelvis) @ turn.T - pelvis,
    )


def resample(motion: Motion, fps: float) -> Motion:
    """Return a motion at another frame rate, from its first frame to at most its last.

    Rotations go from key to key at constant angular velocity (slerp), translations in a line.
    """
    if not 0 < fps < float("inf"):
        raise MotionError(f"motion {motion.name}: cannot be resampled to {fps} frames per second")
    last, step = len(motion) - 1, motion.fps / fps
    # A millionth of a frame forgives the rounding of e.g. 29.97 / 119.88.
    times = torch.arange(int(last / step + 1e-6) + 1, dtype=torch.float64) * step
    before = times.floor().long().clamp(max=last)
    after = (before + 1).clamp(max=last)
    part = (times - before).to(motion.rotations)[:, None]
    start, end = (matrix_from_axis_angle(motion.rotations[frames]) for frames in (before, after))
    change = axis_angle_from_matrix(start.mT @ end) * part[..., None]
    rotations = axis_angle_from_matrix(start @ matrix_from_axis_angle(change))
    translations = torch.lerp(motion.translations[before], motion.translations[after], part)
    return dataclasses.replace(motion, rotations=rotations, translations=translations, fps=fps)


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a motion file that we use, as float64; the rest is not opened."""
    if path.suffix != ".npz":
        raise MotionError(f"motion file {path}: expected an AMASS or SMPL-X .npz, found {path.suffix!r}")
    if not path.is_file():
        raise MotionError(f"motion file {path}: no such file")
    used = ("poses", *_JOINTS_OF_KEY, *_TRANSLATION_KEYS, *_RATE_KEYS)
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {key: np.atleast_1d(file[key]).astype(np.float64) for key in used if key in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise MotionError(
            f"motion file {path}: cannot be read ({error}); expected arrays of numbers"
        ) from error
    for key, array in arrays.items():
        bad = np.argwhere(~np.isfinite(array))
        if len(bad):
            raise MotionError(
                f"motion file {path}: {key} has {len(bad)} values that are not finite, first at "
                f"frame {bad[0][0]}; cut those frames out"
            )
    return arrays


def _read_rotations(path: Path, arrays: Mapping[str, np.ndarray]) -> Float[np.ndarray, "f 55 3"]:
    """Return the rotations in SMPL-X's order, zero where the file has none."""
    if "poses" in arrays:
        poses = arrays["poses"]
        if poses.ndim != 2 or poses.shape[1] not in _JOINTS_OF_COLUMNS:
            raise MotionError(
                f"motion file {path}: poses has shape {poses.shape}, expected (frames, "
                f"{' | '.join(map(str, _JOINTS_OF_COLUMNS))}) of axis-angles"
            )
        joints = _JOINTS_OF_COLUMNS[poses.shape[1]]
        parts = [("poses", joints, poses[:, : 3 * len(joints)])]
    else:
        for keys in (_ROOT_KEYS, _BODY_KEYS):
            _one_key(path, arrays, keys, instead="poses")
        parts = [(key, [*joints], arrays[key]) for key, joints in _JOINTS_OF_KEY.items() if key in arrays]
    frames = min(len(values) for _, _, values in parts)
    if frames == 0:
        raise MotionError(f"motion file {path}: has no frames")
    rotations = np.zeros((frames, len(JOINT_NAMES), 3))
    for key, joints, values in parts:
        found, expected = (len(values), values[0].size), (frames, 3 * len(joints))
        if found != expected:
            raise MotionError(
                f"motion file {path}: {key} has {found} values, expected {expected} axis-angles"
            )
        rotations[:, joints] = values.reshape(frames, -1, 3)
    return rotations


def _one_key(path: Path, arrays: Mapping[str, np.ndarray], keys: tuple[str, ...], instead: str = "") -> str:
    """Return the first of the keys that the file has, or raise."""
    found = next((key for key in keys if key in arrays), None)
    if found is None:
        wanted = " or ".join((*keys, instead) if instead else keys)
        raise MotionError(
            f"motion file {path}: lacks {wanted}; it has {', '.join(arrays) or 'nothing we know'}"
        )
    return found
