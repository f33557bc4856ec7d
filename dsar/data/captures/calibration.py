"""Cameras as calibration files hold them, checked and brought to our conventions."""

import math
import re
import unicodedata
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.errors import CaptureError
from dsar.types import Camera

_RIGID_TOLERANCE = 1e-4


def make_camera(where: str, name: str, K: Any, T_camera_world: Any, size: tuple[int, int]) -> Camera:
    """Return a camera, checked.

    Args:
        where: What to name in errors.
        name: A valid identifier.
        K: Numbers that make 3x3 intrinsics in pixels; the image's corner is (0, 0).
        T_camera_world: Numbers that make a rigid 4x4 transform, world to camera (x right, y down, z forward).
        size: Width and height in pixels.

    Raises:
        CaptureError: They are no such numbers.
    """
    intrinsics = _matrix(K, 3, f"{where}: K")
    if not (
        intrinsics[0, 0] > 0
        and intrinsics[1, 1] > 0
        and intrinsics[1, 0] == 0
        and torch.equal(intrinsics[2], torch.tensor([0.0, 0.0, 1.0]))
    ):
        raise CaptureError(
            f"{where}: expected K as [[fx, s, cx], [0, fy, cy], [0, 0, 1]], found {intrinsics.tolist()}"
        )
    transform = _matrix(T_camera_world, 4, f"{where}: T_camera_world")
    rotation = transform[:3, :3].double()
    error = float((rotation @ rotation.T - torch.eye(3).double()).abs().max())
    last = torch.equal(transform[3], torch.tensor([0.0, 0.0, 0.0, 1.0]))
    if error > _RIGID_TOLERANCE or torch.linalg.det(rotation) < 0 or not last:
        raise CaptureError(
            f"{where}: T_camera_world is not rigid (rows off orthonormal by {error:.1e}, "
            f"determinant {float(torch.linalg.det(rotation)):.3f}); expected a rotation, a translation and "
            "a last row 0 0 0 1"
        )
    width, height = size
    if width < 1 or height < 1:
        raise CaptureError(f"{where}: expected a size in pixels, found {width}x{height}")
    return Camera(intrinsics, transform, width, height, name)


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
    return make_camera(where, camera_name(name), intrinsics.tolist(), transform.tolist(), size)


def camera_name(name: str) -> str:
    """Return a camera's name as an identifier: `0004` becomes `cam_0004`, `vorne 2` `vorne_2`."""
    letters = (sign if sign.isascii() else f"u{ord(sign):04x}" for sign in unicodedata.normalize("NFC", name))
    plain = re.sub(r"\W", "_", "".join(letters), flags=re.ASCII)
    return plain if plain.isidentifier() else f"cam_{plain}"


def _matrix(value: Any, size: int, where: str) -> Float[Tensor, "n n"]:
    try:
        matrix = torch.tensor(value, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        raise CaptureError(f"{where} is not a {size}x{size} matrix of numbers ({error})") from error
    if matrix.shape != (size, size) or not bool(matrix.isfinite().all()):
        raise CaptureError(f"{where} is not a {size}x{size} matrix of finite numbers, found {value}")
    return matrix
