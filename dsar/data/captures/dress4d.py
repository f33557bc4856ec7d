"""4D-DRESS: takes of one outfit with scans, SMPL-X fits and four released cameras.

SUBJECT/OUTFIT/TakeN/
  basic_info.pkl                      scan_frames: the frames' names; gender
  SMPLX/mesh-fFRAME_smplx.pkl         the fit: hands as 12 principal components about the model's mean
  Capture/cameras.pkl                 intrinsics 3x3 and extrinsics 3x4 (OpenCV, world to camera) by camera
  Capture/CAMERA/images/capture-fFRAME.png, masks/mask-fFRAME.png
  Meshes_pkl/mesh-fFRAME.pkl, atlas-fFRAME.pkl
  Semantic/labels/label-fFRAME.pkl    scan_labels: 0 to 5 for each vertex of the mesh (optional)

Its pickles are read without running them.
"""

import logging
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.body.files import choose_body, load_hands
from dsar.body.model import FACE_JOINTS, JOINT_NAMES
from dsar.data.captures.calibration import opencv_camera
from dsar.data.captures.multiview import MultiViewCapture
from dsar.data.captures.scans import PhotosAndScans, Scans, virtual_cameras
from dsar.data.captures.takes import OpenOptions, Take, make_capture, rotate_camera_world, rotation_to_upright
from dsar.data.folders import check_name, list_folder, list_images
from dsar.data.images.conversions import ConversionLog
from dsar.data.images.decoding import image_size
from dsar.data.images.photos import Photos
from dsar.errors import CaptureError, MotionError
from dsar.pickles import PICKLE_ERRORS, read_pickle
from dsar.types import Camera, Motion

FPS = 30.0
_INFO = "basic_info.pkl"
_LEFT, _RIGHT = FACE_JOINTS.stop, FACE_JOINTS.stop + 15
# Parts of a fit, where their joints go, and how many numbers they may have; hands may also be components.
_PARTS = {
    "global_orient": (0, 1),
    "body_pose": (1, 21),
    "jaw_pose": (22, 1),
    "leye_pose": (23, 1),
    "reye_pose": (24, 1),
    "left_hand_pose": (_LEFT, 15),
    "right_hand_pose": (_RIGHT, 15),
}
_OPTIONAL = ("jaw_pose", "leye_pose", "reye_pose")
_FLAT = 45
LOGGER = logging.getLogger(__name__)


def is_4d_dress(root: Path) -> bool:
    """Return whether a folder holds takes of 4D-DRESS, or is one."""
    return bool(_takes(root))


def open_4d_dress(root: Path, options: OpenOptions) -> MultiViewCapture:
    """Return an outfit's capture: every take a sequence, the last third of them held out.

    Where the textured scans are there too, cameras of our own see them beside the released ones.

    Raises:
        CaptureError: something is missing or malformed, or is no data but a program.
        MotionError: a fit has the wrong length or values that are not finite.
        BodyError: the user's body file is not usable.
    """
    folders = _takes(root)
    released, names = _read_cameras(folders[0])
    for folder in folders[1:]:
        if not _same_cameras(released, _read_cameras(folder)[0]):
            raise CaptureError(
                f"{folder / 'Capture' / 'cameras.pkl'}: differs from that of {folders[0].name}; open takes "
                "that were calibrated apart one by one"
            )
    info = [_read_info(folder) for folder in folders]
    gender = str(info[0][1] or "neutral")
    body = choose_body(options.body, gender)
    hands = load_hands(body) if body else None
    if hands is None:
        LOGGER.warning(
            "Capture %s: its hands are given in SMPL-X's principal components, which need its file: they "
            "stay at rest. Give --body or $DSAR_BODY",
            root,
        )
    scans = [
        Scans(folder / "Meshes_pkl", frames, folder / "Semantic" / "labels")
        for folder, (frames, _) in zip(folders, info, strict=True)
    ]
    fits = [_read_fits(folder, scan.frames, hands) for folder, scan in zip(folders, scans, strict=True)]
    virtual = []
    if all(scan.complete for scan in scans):
        R_world_file = rotation_to_upright(str(root), [motion for motion, _ in fits])
        ring = virtual_cameras(
            [rotate_camera_world(c, R_world_file) for c in released], R_world_file.numpy() @ scans[0].center
        )
        virtual = [rotate_camera_world(camera, R_world_file.T) for camera in ring]
    takes, conversions = [], ConversionLog(f"{root.parent.name}_{root.name}")
    for folder, scan, (motion, _) in zip(folders, scans, fits, strict=True):
        photos = Photos(
            folder / "Capture",
            "{camera}/images/capture-f{frame}.png",
            "{camera}/masks/mask-f{frame}.png",
            frames=scan.frames,
            folders=names,
            conversions=conversions,
        )
        views = PhotosAndScans(photos, scan, *({c.name: c for c in group} for group in (virtual, released)))
        takes.append(Take(motion, views))
    return make_capture(
        root,
        f"{root.parent.name}_{root.name}",
        [*released, *virtual],
        takes,
        options,
        partial(open_4d_dress, root, options),
        betas=torch.stack([betas for _, betas in fits]).mean(0),
        gender=gender,
    )


def _takes(root: Path) -> list[Path]:
    """Return the takes' folders in order: the folder itself, or those in it."""
    folders = [root] if (root / _INFO).is_file() else sorted(list_folder(root), key=_take_order)
    return [folder for folder in folders if (folder / _INFO).is_file()]


def _take_order(folder: Path) -> tuple[int, str]:
    """Return what puts Take10 after Take9."""
    digits = re.findall(r"\d+", folder.name)
    return int(digits[-1]) if digits else 0, folder.name


def read_data(path: Path) -> Mapping[str, Any]:
    """Return the dictionary that one of the data set's pickles holds.

    Raises:
        CaptureError: it is missing, damaged, no dictionary, or would run code.
    """
    if not path.is_file():
        raise CaptureError(f"{path}: no such file; expected 4D-DRESS's layout (docs/capture-format.md)")
    try:
        content = read_pickle(path)
    except PICKLE_ERRORS as error:
        raise CaptureError(f"{path}: cannot be read as data ({error}); download it again") from error
    if not isinstance(content, Mapping):
        raise CaptureError(f"{path}: expected a dictionary, found a {type(content).__name__}")
    return content


def _read_info(folder: Path) -> tuple[list[str], str | None]:
    info = read_data(folder / _INFO)
    scan_frames = info.get("scan_frames")
    frames = (
        [str(frame) for frame in scan_frames] if isinstance(scan_frames, (list, tuple, np.ndarray)) else []
    )
    if not frames:
        raise CaptureError(f"{folder / _INFO}: expected the names of frames as scan_frames, found none")
    gender = info.get("gender")
    for frame in frames:
        check_name(str(folder / _INFO), frame)
    return [frame.zfill(5) for frame in frames], gender


def _read_cameras(folder: Path) -> tuple[list[Camera], dict[str, str]]:
    where = folder / "Capture" / "cameras.pkl"
    cameras, names = [], {}
    for name, entry in read_data(where).items():
        at = f"{where}, camera {name}"
        if not (isinstance(entry, Mapping) and {"intrinsics", "extrinsics"} <= entry.keys()):
            raise CaptureError(f"{at}: expected intrinsics 3x3 and extrinsics 3x4")
        extrinsics = np.asarray(entry["extrinsics"], dtype=object)
        if extrinsics.shape not in ((3, 4), (4, 4)):
            raise CaptureError(f"{at}: expected extrinsics of 3x4, found {extrinsics.shape}")
        images = folder / "Capture" / str(name) / "images"
        check_name(at, str(name))
        size = image_size(next(iter(list_images(images)), images / "capture-f00000.png"))
        K = np.asarray(entry["intrinsics"], dtype=object).tolist()
        camera = opencv_camera(
            at, str(name), K, extrinsics[:3, :3].tolist(), extrinsics[:3, 3].tolist(), size
        )
        cameras.append(camera)
        names[camera.name] = str(name)
    if not cameras:
        raise CaptureError(f"{where}: expected cameras by name, found none")
    return cameras, names


def _same_cameras(one: Sequence[Camera], other: Sequence[Camera]) -> bool:
    """Return whether cameras are the same but for rounding."""
    if [(c.name, c.width, c.height) for c in one] != [(c.name, c.width, c.height) for c in other]:
        return False
    return all(
        torch.allclose(a.K, b.K, atol=1e-3) and torch.allclose(a.T_camera_world, b.T_camera_world, atol=1e-5)
        for a, b in zip(one, other, strict=True)
    )


def _read_fits(
    folder: Path, frames: Sequence[str], hands: tuple[Float[Tensor, "2 k 45"], Float[Tensor, "2 45"]] | None
) -> tuple[Motion, Float[Tensor, " s"]]:
    """Return a take's motion and its mean shape."""
    paths = [folder / "SMPLX" / f"mesh-f{frame}_smplx.pkl" for frame in frames]
    fits = [_read_fit(path, hands) for path in paths]
    for path, (_, _, betas) in zip(paths, fits, strict=True):
        if len(betas) != len(fits[0][2]):
            raise MotionError(
                f"motion file {path}: betas has {len(betas)} numbers, {paths[0]} {len(fits[0][2])}"
            )
    rotations, translations, shapes = (torch.stack(each) for each in zip(*fits, strict=True))
    return Motion(rotations, translations, FPS, folder.name), shapes.mean(0)


def _read_fit(
    path: Path, hands: tuple[Float[Tensor, "2 k 45"], Float[Tensor, "2 45"]] | None
) -> tuple[Float[Tensor, "55 3"], Float[Tensor, "3"], Float[Tensor, " s"]]:
    """Return a frame's axis-angles, translation and shape."""
    content = read_data(path)
    rotations = torch.zeros(len(JOINT_NAMES), 3)
    for key, (first, count) in _PARTS.items():
        if key not in content and key in _OPTIONAL:
            continue
        numbers = _numbers(path, content, key)
        if "hand" in key and len(numbers) < _FLAT:
            numbers = _open_hand(numbers, hands, int(key.startswith("right")))
        if len(numbers) != 3 * count:
            raise MotionError(f"motion file {path}: {key} has {len(numbers)} numbers, expected {3 * count}")
        rotations[first : first + count] = numbers.reshape(count, 3)
    translation = _numbers(path, content, "transl")
    if len(translation) != 3:
        raise MotionError(f"motion file {path}: transl has {len(translation)} numbers, expected 3")
    return rotations, translation, _numbers(path, content, "betas")


def _open_hand(
    components: Float[Tensor, " k"],
    hands: tuple[Float[Tensor, "2 n 45"], Float[Tensor, "2 45"]] | None,
    side: int,
) -> Float[Tensor, "45"]:
    """Return axis-angles from principal components about the model's mean pose."""
    if hands is None:
        return torch.zeros(_FLAT)
    return components @ hands[0][side, : len(components)] + hands[1][side]


def _numbers(path: Path, content: Mapping[str, Any], key: str) -> Float[Tensor, " n"]:
    if key not in content:
        raise MotionError(f"motion file {path}: lacks {key}; it has {', '.join(map(str, content))}")
    try:
        numbers = torch.from_numpy(np.asarray(content[key], dtype=np.float64).ravel()).float()
    except (TypeError, ValueError) as error:
        raise MotionError(f"motion file {path}: {key} is not made of numbers ({error})") from error
    if not bool(numbers.isfinite().all()):
        raise MotionError(f"motion file {path}: {key} has values that are not finite; cut that frame out")
    return numbers
