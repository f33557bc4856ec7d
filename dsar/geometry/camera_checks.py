"""What makes a camera: the checks that all readers of cameras share."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.errors import DsarError
from dsar.types import Camera

RIGID_TOLERANCE = 1e-4
"""How far the products of a rotation's rows may be from those of an orthonormal basis."""
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def make_camera(
    where: str,
    name: Any,
    K: Any,
    T_camera_world: Any,
    size: tuple[Any, Any],
    error: type[DsarError],
) -> Camera:
    """Return a camera of what a file says of it, checked.

    Args:
        where: What to name in errors.
        name: An identifier.
        K: Numbers that make 3x3 intrinsics in pixels; the image's corner is (0, 0).
        T_camera_world: Numbers that make a rigid 4x4 transform, world to camera (x right, y down, z forward).
        size: Width and height in pixels.
        error: Raised, with a message, where they make no camera.
    """
    check_name(where, name, error)
    width, height = (check_size(where, key, size[k], error) for k, key in enumerate(("width", "height")))
    intrinsics = _matrix(where, "K", K, 3, error)
    if not (
        intrinsics[0, 0] > 0
        and intrinsics[1, 1] > 0
        and intrinsics[1, 0] == 0
        and intrinsics[2].tolist() == [0.0, 0.0, 1.0]
    ):
        raise error(
            f"{where}: expected K as [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels, fx and fy > 0, found "
            f"{intrinsics.tolist()}: correct it"
        )
    transform = _matrix(where, "T_camera_world", T_camera_world, 4, error)
    rotation, last_row = transform[:3, :3].double().numpy(), transform[3].tolist()
    determinant, distance = float(np.linalg.det(rotation)), distance_from_orthonormal(rotation)
    if distance > RIGID_TOLERANCE or determinant < 0 or last_row != [0.0, 0.0, 0.0, 1.0]:
        raise error(
            f"{where}: expected T_camera_world as a rotation, a translation and a last row 0 0 0 1, found "
            f"rows off orthonormal by {distance:.1e}, determinant {determinant:.3f} and last row "
            f"{last_row}: take scale and mirroring out"
        )
    return Camera(intrinsics, transform, width, height, name)


def distance_from_orthonormal(axes: Float[np.ndarray, "3 3"]) -> float:
    """Return by how much the products of a matrix' rows differ from those of an orthonormal basis at most."""
    return float(np.abs(axes @ axes.T - np.eye(3)).max())


def check_size(where: str, key: str, value: Any, error: type[DsarError]) -> int:
    """Return a width or height in pixels, or raise `error`."""
    if type(value) is not int or value < 1:
        raise error(f"{where}: expected {key} in pixels, a whole number > 0, found {quote_value(value)}")
    return value


def check_name(where: str, name: Any, error: type[DsarError]) -> str:
    """Return a camera's name, which has to be an identifier, or raise `error`."""
    if not isinstance(name, str) or not _IDENTIFIER.fullmatch(name):
        raise error(
            f"{where}: expected a name of letters, digits and _ (no leading digit), found "
            f"{quote_value(name)}: rename the camera"
        )
    return name


def check_names_differ(where: str, names: Sequence[str], error: type[DsarError]) -> None:
    """Raise `error` where two cameras have one name."""
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise error(f"{where}: expected names that differ, found {', '.join(repeated)} twice: rename one")


def quote_value(value: Any) -> str:
    """Return a value from a file, short enough for a message."""
    text = repr(value)
    return text if len(text) <= 100 else f"{text[:97]}..."


def _matrix(where: str, key: str, value: Any, size: int, error: type[DsarError]) -> Float[Tensor, "n n"]:
    try:
        matrix = torch.tensor(value, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        matrix = torch.empty(0)
    if matrix.shape != (size, size) or not bool(matrix.isfinite().all()):
        raise error(
            f"{where}: expected {key} as a {size}x{size} list of finite numbers, found "
            f"{quote_value(value)}: write it as in docs/capture-format.md"
        )
    return matrix
