"""SMPL-X poses as files hold them: `poses`, or its parts under AMASS's or SMPL-X's names."""

import logging
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

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
_WOUND = 4
"""Joints beyond a full turn at once that tell degrees from radians."""
_RATE_KEYS = ("mocap_frame_rate", "mocap_framerate", "fps")

# What files under the name .npz really are, by their first bytes.
_FOREIGN = {b"\x93NUMPY": "a single .npy array", b"\x80": "a pickle", b"HIERAR": "a .bvh", b"\x89HDF": "HDF5"}
_DAMAGE = (
    *(ValueError, EOFError, KeyError, NotImplementedError, RuntimeError, MemoryError, OverflowError),
    *(TypeError, struct.error, zipfile.BadZipFile, zlib.error),
)
"""What NumPy and zipfile raise for damaged and foreign files."""
_OTHER_ROTATIONS = {4: "quaternions", 6: "six-dimensional rotations", 9: "rotation matrices"}
"""By how many numbers a joint has."""
_SMPL_BODY = 69
"""Columns of SMPL's body without its root: the last two joints are hands as lumps."""
_HAND_KEYS, _MOST_COMPONENTS = ("left_hand_pose", "right_hand_pose"), 24
LOGGER = logging.getLogger(__name__)


def read_arrays(path: Path, *also: str) -> dict[str, np.ndarray]:
    """Return the arrays of a motion file that we use, and others by name, as float64; the rest is not opened.

    Raises:
        MotionError: the file is missing, unreadable, or holds values that are not finite.
    """
    if not path.is_file():
        raise MotionError(f"motion file {path}: no such file")
    used = ("poses", *_JOINTS_OF_KEY, *_TRANSLATION_KEYS, *_RATE_KEYS, *also)
    with path.open("rb") as stream:
        if not zipfile.is_zipfile(stream):
            raise MotionError(f"motion file {path}: cannot be read: {_what_instead(stream)}")
        stream.seek(0)
        arrays = {}
        try:
            with np.load(stream, allow_pickle=False) as file:
                for key in used:
                    if key in file.files:
                        arrays[key] = np.atleast_1d(file[key]).astype(np.float64)
        except _DAMAGE as error:
            reason = str(error) or type(error).__name__
            if "allow_pickle" in reason:
                reason = "it holds Python objects, which could run code; save plain arrays"
            raise MotionError(
                f"motion file {path}: cannot be read ({reason}); expected arrays of numbers"
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
    key = _one_key(path, arrays, _TRANSLATION_KEYS)
    translations = _by_frame(path, key, arrays[key], [3])
    if translations.shape != (len(rotations), 3):
        expected = (len(rotations), 3)
        raise MotionError(f"motion file {path}: trans has shape {translations.shape}, expected {expected}")
    return torch.from_numpy(rotations).float(), torch.from_numpy(translations).float()


def read_rate(path: Path, arrays: Mapping[str, np.ndarray]) -> float:
    """Return the frames per second that a file says it has, under any of the names in use."""
    key = next((key for key in _RATE_KEYS if key in arrays), None)
    if key is None:
        raise MotionError(
            f"motion file {path}: lacks {' or '.join(_RATE_KEYS)}, so its frame rate is unknown; say it with "
            "--motion-fps"
        )
    rate = arrays[key]
    if rate.size != 1 or not rate.item() > 0:
        raise MotionError(
            f"motion file {path}: the frame rate is {rate}, expected one number above 0; say it "
            "with --motion-fps"
        )
    return rate.item()


def _read_rotations(path: Path, arrays: Mapping[str, np.ndarray]) -> Float[np.ndarray, "f 55 3"]:
    """Return the rotations in SMPL-X's order, zero where the file has none."""
    if "poses" in arrays:
        poses = _by_frame(path, "poses", arrays["poses"], [*_JOINTS_OF_COLUMNS])
        joints = _JOINTS_OF_COLUMNS[poses.shape[1]]
        parts = [("poses", joints, poses[:, : 3 * len(joints)])]
    else:
        for keys in (_ROOT_KEYS, _BODY_KEYS):
            _one_key(path, arrays, keys, instead="poses")
        parts = []
        for key, joints in _JOINTS_OF_KEY.items():
            if key in arrays and not _is_compressed(path, key, arrays[key]):
                columns = [3 * len(joints), *([_SMPL_BODY] if key in _BODY_KEYS else [])]
                values = _by_frame(path, key, arrays[key], columns)
                parts.append((key, [*joints], values[:, : columns[0]]))
    frames = len(parts[0][2])
    if frames == 0:
        raise MotionError(f"motion file {path}: has no frames")
    rotations = np.zeros((frames, len(JOINT_NAMES), 3))
    for key, joints, values in parts:
        if len(values) != frames:
            raise MotionError(
                f"motion file {path}: {key} has {len(values)} frames, expected {frames} as {parts[0][0]}"
            )
        rotations[:, joints] = values.reshape(frames, -1, 3)
    _check_radians(path, rotations)
    return rotations


def _by_frame(path: Path, key: str, values: np.ndarray, columns: Sequence[int]) -> Float[np.ndarray, "f c"]:
    """Return a row a frame, from any arrangement of values that has one meaning, or raise."""
    *leading, last = values.shape
    frames = sum(size != 1 for size in leading)
    if last in columns and frames <= 1:
        return values.reshape(-1, last)
    if last == 3 and leading and 3 * leading[-1] in columns and frames - (leading[-1] != 1) <= 1:
        return values.reshape(-1, 3 * leading[-1])
    if len(leading) == 1 and leading[0] in columns:
        LOGGER.info("%s: %s is %d x %d, a frame a column: transposed", path.name, key, *values.shape)
        return values.T
    kind = next(
        (name for size, name in _OTHER_ROTATIONS.items() if 3 * last in [size * c for c in columns]), None
    )
    if len(leading) > 1:
        kind = _OTHER_ROTATIONS.get(9 if values.shape[-2:] == (3, 3) else last)
    hint = f": {kind}, it seems; convert them" if kind else ""
    expected = f"(frames, {' | '.join(map(str, columns))})"
    expected += "" if key in _TRANSLATION_KEYS else " of axis-angles"
    raise MotionError(f"motion file {path}: {key} has shape {values.shape}, expected {expected}{hint}")


def _is_compressed(path: Path, key: str, values: np.ndarray) -> bool:
    """Whether a hand's pose is given by principal components; say so."""
    compressed = key in _HAND_KEYS and values.shape[-1] <= _MOST_COMPONENTS
    if compressed:
        LOGGER.warning("%s: %s is given by principal components: hands stay at rest", path.name, key)
    return compressed


def _check_radians(path: Path, rotations: Float[np.ndarray, "f 55 3"]) -> None:
    """Raise where several joints of a body go beyond a full turn in most frames, as nobody's do."""
    angles = np.linalg.norm(rotations[:, 1 : FACE_JOINTS.start], axis=2)
    # One joint may: rotations that were made continuous add turns up.
    least = np.median(np.sort(angles, axis=1)[:, -_WOUND])
    if least > 1.2 * 2 * np.pi:
        raise MotionError(
            f"motion file {path}: in most frames {_WOUND} joints turn by {least:.0f} radians or more; the "
            "poses are in degrees, it seems: convert them with numpy.deg2rad"
        )


def _what_instead(stream: BinaryIO) -> str:
    """Return what a file is that is no zip archive, as .npz are."""
    stream.seek(0)
    start = stream.read(8)
    if start.startswith(b"PK"):
        return "it is cut, its end is missing; copy it again"
    kind_of_file = next(
        (kind for mark, kind in _FOREIGN.items() if start.startswith(mark)), "no .npz archive"
    )
    what = kind_of_file if start else "empty"
    return f"it is {what}; save poses, trans and mocap_frame_rate with numpy.savez"


def _one_key(path: Path, arrays: Mapping[str, np.ndarray], keys: tuple[str, ...], instead: str = "") -> str:
    """Return the first of the keys that the file has, or raise."""
    present = next((key for key in keys if key in arrays), None)
    if present is None:
        wanted = " or ".join((*keys, instead) if instead else keys)
        raise MotionError(
            f"motion file {path}: lacks {wanted}; it has {', '.join(arrays) or 'nothing we know'}"
        )
    return present
