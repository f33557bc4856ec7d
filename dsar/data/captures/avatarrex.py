"""Captures of one take with a calibration and SMPL-X fits: AvatarReX, THuman4.0, ActorsHQ.

AvatarReX and THuman4.0 give OpenCV calibrations, ActorsHQ camera-to-world axis-angles and intrinsics as
shares of the image. Each has smpl_params.npz: neutral SMPL-X, hands as 45 numbers with a flat mean.
"""

import csv
import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch

from dsar.data.captures.calibration import camera_name, opencv_camera
from dsar.data.captures.multiview import MultiViewCapture
from dsar.data.captures.takes import OpenOptions, Take, make_capture
from dsar.data.folders import check_name, find_file, list_folder, list_images
from dsar.data.images.conversions import ConversionLog
from dsar.data.images.decoding import image_size
from dsar.data.images.distortion import parse_distortion
from dsar.data.images.photos import Photos, read_missing_list
from dsar.data.motions.smplx_npz import read_arrays, read_poses
from dsar.errors import CaptureError
from dsar.geometry.camera_checks import make_camera
from dsar.geometry.rotations import matrix_from_axis_angle
from dsar.text import read_json, read_text
from dsar.types import Camera, Motion

PARAMETERS = "smpl_params.npz"


def open_avatarrex(root: Path, options: OpenOptions) -> MultiViewCapture:
    """Return a capture in AvatarReX's layout (30 frames a second).

    Raises:
        CaptureError: calibration or images are missing or malformed.
        MotionError: the fits are.
        BodyError: the user's body file is.
    """
    views = {"color": "{camera}/{frame:08d}.jpg", "mask": "{camera}/mask/pha/{frame:08d}.jpg"}
    cameras, photos = _read_calibration(find_file(root, "calibration_full.json"), root, views)
    return _capture(root, cameras, photos, 30.0, options, open_avatarrex)


def open_thuman4(root: Path, options: OpenOptions) -> MultiViewCapture:
    """Return a capture in THuman4.0's layout (30 frames a second); raises as `open_avatarrex` does."""
    views = {"color": "images/{camera}/{frame:08d}.jpg", "mask": "masks/{camera}/{frame:08d}.jpg"}
    cameras, photos = _read_calibration(find_file(root, "calibration.json"), root, views)
    return _capture(root, cameras, photos, 30.0, options, open_thuman4)


def open_actorshq(root: Path, options: OpenOptions) -> MultiViewCapture:
    """Return a capture in ActorsHQ's layout (25 frames a second); raises as `open_avatarrex` does."""
    where = actorshq_calibration(root) or root / "calibration.csv"
    cameras, folders = [], {}
    try:
        for row in csv.DictReader(read_text(where, CaptureError).splitlines()):
            camera = _read_row(f"{where}, camera {row['name']}", row)
            cameras.append(camera)
            folders[camera.name] = check_name(str(where), row["name"])
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        if isinstance(error, CaptureError):
            raise
        raise CaptureError(f"{where}: expected name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py ({error})") from error
    photos = Photos(
        where.parent,
        "rgbs/{camera}/{camera}_rgb{frame:06d}.jpg",
        "masks/{camera}/{camera}_mask{frame:06d}.png",
        frames=(),
        folders=folders,
        conversions=ConversionLog(root.name),
    )
    return _capture(root, cameras, photos, 25.0, options, open_actorshq)


def actorshq_calibration(root: Path) -> Path | None:
    """Return the calibration of the first resolution that a folder has, or its own; None without one."""
    folders = [folder for folder in list_folder(root) if folder.name.endswith("x")]
    files = (find_file(folder, "calibration.csv") for folder in [*folders, root])
    return next((file for file in files if file.is_file()), None)


def _read_row(where: str, row: Mapping[str, str]) -> Camera:
    width, height = int(row["w"]), int(row["h"])
    numbers = {key: float(row[key]) for key in ("rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")}
    # Shares of the image count from its corner: no half pixel is missing.
    K = [
        [numbers["fx"] * width, 0, numbers["px"] * width],
        [0, numbers["fy"] * height, numbers["py"] * height],
        [0, 0, 1],
    ]
    rotation_vector = torch.tensor([numbers[key] for key in ("rx", "ry", "rz")], dtype=torch.float64)
    center = torch.tensor([numbers[key] for key in ("tx", "ty", "tz")], dtype=torch.float64)
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3] = matrix_from_axis_angle(rotation_vector).T
    transform[:3, 3] = -transform[:3, :3] @ center
    return make_camera(where, camera_name(row["name"]), K, transform.tolist(), (width, height), CaptureError)


def _read_calibration(where: Path, root: Path, views: Mapping[str, str]) -> tuple[list[Camera], Photos]:
    record = _read_json(where)
    cameras, folders, distortion = [], {}, {}
    for name, entry in record.items():
        at = f"{where}, camera {name}"
        missing = [key for key in ("K", "R", "T") if not isinstance(entry, dict) or key not in entry]
        if missing:
            raise CaptureError(
                f"{at}: expected K, R, T, distCoeff and imgSize, found no {', '.join(missing)}"
            )
        size = entry.get("imgSize") or _first_size(root, views["color"], name)
        if not (isinstance(size, (list, tuple)) and len(size) == 2 and all(type(n) is int for n in size)):
            raise CaptureError(f"{at}: expected imgSize as [width, height], found {size}")
        camera = opencv_camera(at, name, entry["K"], entry["R"], entry["T"], (size[0], size[1]))
        cameras.append(camera)
        folders[camera.name] = check_name(at, name)
        distortion[camera.name] = parse_distortion(at, entry.get("distCoeff") or ())
    if not cameras or len(folders) != len(cameras):
        raise CaptureError(
            f"{where}: expected cameras whose names differ in letters and digits, found {list(record)}"
        )
    lists = [
        read_missing_list(find_file(root, name))
        for name in ("missing_img_files.txt", "missing_msk_files.txt")
    ]
    photos = Photos(
        root,
        views["color"],
        views["mask"],
        frames=(),
        folders=folders,
        distortion=distortion,
        missing=lists[0] | lists[1],
        conversions=ConversionLog(root.name),
    )
    return cameras, photos


def _first_size(root: Path, pattern: str, camera: str) -> tuple[int, int]:
    first = root / pattern.format(camera=camera, frame=0)
    return image_size(next(iter(list_images(first.parent)), first))


def _read_json(where: Path) -> dict[str, Any]:
    record = read_json(where, CaptureError)
    if not isinstance(record, dict):
        raise CaptureError(f"{where}: expected cameras by name, found a {type(record).__name__}")
    return record


def _capture(
    root: Path,
    cameras: list[Camera],
    photos: Photos,
    fps: float,
    options: OpenOptions,
    open_again: Callable[[Path, OpenOptions], MultiViewCapture],
) -> MultiViewCapture:
    path = find_file(root, PARAMETERS)
    arrays = read_arrays(path, "betas")
    rotations, translations = read_poses(path, arrays)
    betas = arrays.get("betas")
    if betas is None or not betas.size:
        raise CaptureError(f"motion file {path}: expected the person's shape as betas, found none")
    # One shape for the whole take: files repeat it by frame, or hold it once.
    shape = torch.from_numpy(betas.reshape(-1, betas.shape[-1])[0]).float()
    take = Take(
        Motion(rotations, translations, fps, camera_name(root.name).removeprefix("cam_")),
        dataclasses.replace(photos, frames=range(len(rotations))),
    )
    reopen = partial(open_again, root, options)
    return make_capture(root, root.name, cameras, [take], options, reopen, betas=shape)
