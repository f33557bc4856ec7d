"""Cameras of OpenCV calibrations, brought to our conventions."""

import math
import re
import unicodedata
from typing import Any

import torch

from dsar.errors import CaptureError
from dsar.geometry.camera_checks import make_camera
from dsar.types import Camera


def opencv_camera(where: str, name: str, K: Any, R: Any, T: Any, size: tuple[int, int]) -> Camera:
    """Return a camera from an OpenCV calibration: x_camera = R x_world + T.

    OpenCV's pixel centres are whole numbers; half a pixel is added to the principal point.

    Args:
        where: What to name in errors.
        name: The calibration's name of the camera; made an identifier.
        K: Nine numbers row by row, or 3x3.
        R: Likewise.
        T: Three numbers.
        size: Width and height in pixels.

    Raises:
        CaptureError: They are no such numbers.
    """
    matrices = []
    for key, value, shape in (("K", K, (3, 3)), ("R", R, (3, 3)), ("T", T, (3,))):
        try:
            tensor = torch.tensor(value, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError) as error:
            raise CaptureError(f"{where}: {key} is not made of numbers ({error})") from error
        if tensor.numel() != math.prod(shape):
            raise CaptureError(f"{where}: expected {key} of {math.prod(shape)} numbers, found {value}")
        matrices.append(tensor.reshape(shape))
    intrinsics, rotation, translation = matrices
    intrinsics[:2, 2] += 0.5
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3], transform[:3, 3] = rotation, translation
    return make_camera(where, camera_name(name), intrinsics.tolist(), transform.tolist(), size, CaptureError)


def camera_name(name: str) -> str:
    """Return a camera's name as an identifier: `0004` becomes `cam_0004`, `vorne 2` `vorne_2`."""
    letters = (sign if sign.isascii() else f"u{ord(sign):04x}" for sign in unicodedata.normalize("NFC", name))
    plain = re.sub(r"\W", "_", "".join(letters), flags=re.ASCII)
    return plain if plain.isidentifier() else f"cam_{plain}"
