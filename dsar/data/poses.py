"""SMPL-X poses as files hold them: `poses`, or its parts under AMASS's or SMPL-X's names."""

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.body.model import FACE_JOINTS, JOINT_NAMES
from dsar.errors import MotionError

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


def read_arrays(path: Path, *also: str) -> dict[str, np.ndarray]:
    """Return the arrays of a motion file that we use, and others by name, as float64; the rest is not opened.

    Raises:
        MotionError: the file is missing, unreadable, or holds values that are not finite.
    """
    if not path.is_file():
        raise MotionError(f"motion file {path}: no such file")
    used = ("poses", *_JOINTS_OF_KEY, *_TRANSLATION_KEYS, *_RATE_KEYS, *also)
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


def read_poses(
    path: Path, arrays: Mapping[str, np.ndarray]
) -> tuple[Float[Tensor, "f 55 3"], Float[Tensor, "f 3"]]:
    """Return axis-angles in SMPL-X's order, zero where the file has none, and translations, as they stand.

    Args:
        path: The file, for messages.
        arrays: What `read_arrays` found in it.

    Raises:
        MotionError: something is missing, there are no frames, or lengths disagree.
    """
    rotations = _read_rotations(path, arrays)
    translations = arrays[_one_key(path, arrays, _TRANSLATION_KEYS)]
    if translations.shape != (len(rotations), 3):
        expected = (len(rotations), 3)
        raise MotionError(f"motion file {path}: trans has shape {translations.shape}, expected {expected}")
    return torch.from_numpy(rotations).float(), torch.from_numpy(translations).float()


def read_rate(path: Path, arrays: Mapping[str, np.ndarray]) -> float:
    """Return the frames per second that a file says it has, under any of the names in use."""
    rate = arrays[_one_key(path, arrays, _RATE_KEYS)]
    if rate.size != 1 or not rate.item() > 0:
        raise MotionError(f"motion file {path}: the frame rate is {rate}, expected one number above 0")
    return rate.item()


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
