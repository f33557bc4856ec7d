"""A camera in an EXR's header: worldToCamera, worldToNDC and the lens, written and read back.

OpenEXR's standard attributes: https://openexr.com/en/latest/StandardAttributes.html
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from dsar.types import Camera
from dsar_exporters.exr.openexr import require_openexr

_SENSOR_MM = 36.0
"""Width of the film back that focal lengths refer to: a pinhole camera has none of its own."""


def camera_attributes(camera: Camera) -> dict[str, Any]:
    """Return the attributes that say where a camera stands and how it projects, by name."""
    return {
        "worldToCamera": world_to_camera(camera),
        "worldToNDC": world_to_ndc(camera),
        **_lens(camera),
    }


def world_to_camera(camera: Camera) -> Float32[np.ndarray, "4 4"]:
    """Return OpenEXR's worldToCamera: row vectors, left-handed (x right, y up, z forward), metres."""
    transform = camera.T_camera_world.double().numpy()
    return _row_vector_form(np.diag([1.0, -1.0, 1.0, 1.0]) @ transform)


def world_to_ndc(camera: Camera) -> Float32[np.ndarray, "4 4"]:
    """Return OpenEXR's worldToNDC: row vectors, after division by w (0, 0) top left, (1, 1) bottom right."""
    K = camera.K.double().numpy() / np.array([[camera.width], [camera.height], [1.0]])
    projection = np.zeros((4, 4))
    projection[:2, :3], projection[2, 2], projection[3, 2] = K[:2], 1.0, 1.0
    return _row_vector_form(projection @ camera.T_camera_world.double().numpy())


def read_projections(path: Path) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Return how an image's header maps the world to its pixels: column vectors, pixels times w.

    By `exr`, its worldToNDC, and by `exr_lens`: its worldToCamera, focal length and sensor, which say nothing
    of the principal point, so that is worldToNDC's.
    """
    with require_openexr().File(str(path), header_only=True) as file:
        header = file.header()
        (left, top), (right, bottom) = (np.array(corner) for corner in header["displayWindow"])
        to_ndc = np.array(header["worldToNDC"], np.float64).T
        to_camera = np.array(header["worldToCamera"], np.float64).T
        focal, sensor = float(header["pinholeFocalLength"]), np.array(header["sensorOverallDimensions"])
    size = np.array([right - left + 1.0, bottom - top + 1.0])
    ndc = np.diag([*size, 1.0, 1.0]) @ to_ndc
    lens = np.zeros((4, 4))
    # Its y is up.
    lens[[0, 1], [0, 1]] = focal * size / sensor * [1.0, -1.0]
    lens[:2, 2] = ndc[:2, :3] @ ndc[3, :3]
    lens[3, 2] = 1.0
    return {"exr": ndc, "exr_lens": lens @ to_camera}


def _lens(camera: Camera) -> dict[str, Any]:
    """Return focal length and sensor, as if the sensor were 36 mm wide."""
    fx, fy = float(camera.K[0, 0]), float(camera.K[1, 1])
    height = _SENSOR_MM * camera.height / camera.width * fx / fy
    return {
        "pinholeFocalLength": fx * _SENSOR_MM / camera.width,
        "sensorOverallDimensions": (_SENSOR_MM, height),
    }


def _row_vector_form(matrix: Float[np.ndarray, "4 4"]) -> Float32[np.ndarray, "4 4"]:
    """Return the transpose in memory too: OpenEXR copies an array's buffer and ignores its strides."""
    return np.ascontiguousarray(matrix.T, dtype=np.float32)
