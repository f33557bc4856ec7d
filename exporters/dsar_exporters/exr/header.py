"""What an EXR's header says of camera, time, colour and origin (OpenEXR's standard attributes)."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from dsar.geometry.frame_rates import exact_rate
from dsar.types import Camera, Picture
from dsar_exporters.optional import require

_SENSOR_MM = 36.0
"""Width of the film back that focal lengths refer to: a pinhole camera has none of its own."""

NO_COLOR = "data"
"""The Color Interop Forum's id of what is no colour."""
Window = tuple[int, int, int, int]
"""Left, top, right and bottom pixel, inclusive, in the display window's coordinates."""


def make_header(picture: Picture, interop_id: str, window: Window, job: str) -> dict[str, Any]:
    """Return the header of a part that shows one camera's picture.

    Args:
        picture: What is written.
        interop_id: Of the colour space of R, G and B; `NO_COLOR` of a file without them.
        window: Which pixels the file holds.
        job: Hash of all that the file depends on; written as `dsar/job`.
    """
    camera = picture.camera
    left, top, right, bottom = window
    chromaticities = openexr().colorInteropIDToChromaticities(interop_id)
    return {
        "displayWindow": _box(0, 0, camera.width - 1, camera.height - 1),
        "dataWindow": _box(left, top, right, bottom),
        "worldToCamera": world_to_camera(camera),
        "worldToNDC": world_to_ndc(camera),
        **_lens(camera),
        **_time(picture),
        "cameraLabel": camera.name,
        "view": camera.name,
        "colorInteropID": interop_id,
        # For readers older than OpenEXR 3.4, which know nothing of the id.
        **({"chromaticities": chromaticities} if chromaticities else {}),
        "software": f"dsar {picture.provenance.get('dsar', '')}".strip(),
        **{f"dsar/{key}": value for key, value in picture.provenance.items()},
        "dsar/frame": str(picture.frame),
        "dsar/job": job,
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
    with openexr().File(str(path), header_only=True) as file:
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


def openexr():
    """Return the OpenEXR module.

    Raises:
        MissingDependencyError: It is not installed.
    """
    return require("OpenEXR", feature="EXR", package="OpenEXR", extra="exr")


def _lens(camera: Camera) -> dict[str, Any]:
    """Return focal length and sensor, as if the sensor were 36 mm wide."""
    fx, fy = float(camera.K[0, 0]), float(camera.K[1, 1])
    height = _SENSOR_MM * camera.height / camera.width * fx / fy
    return {
        "pinholeFocalLength": fx * _SENSOR_MM / camera.width,
        "sensorOverallDimensions": (_SENSOR_MM, height),
    }


def _time(picture: Picture) -> dict[str, Any]:
    """Return the frame's rate, number, time code, time in seconds, and how long the shutter was open."""
    rate = exact_rate(picture.fps)
    opens, closes = picture.shutter
    exposure = closes - opens
    shutter = {"shutterAngle": 360.0 * exposure, "expTime": exposure / picture.fps} if exposure else {}
    return {
        "framesPerSecond": rate,
        "imageCounter": picture.frame,
        "timeCode": _time_code(picture.frame, max(round(picture.fps), 1)),
        # From frame 0 of the film, as time codes and USD's time codes count.
        "dsar/seconds": f"{float(picture.frame / rate):.6f}",
        "dsar/shutter": f"{opens:g} {closes:g}",
        **shutter,
    }


def _time_code(frame: int, rate: int):
    """Return hours, minutes, seconds and frames, counted without drops, frame 0 at midnight.

    A time code has at most 30 frames a second (SMPTE ST 12-1): above, it counts them in twos, or more.
    """
    seconds, frames = divmod(max(frame, 0), rate)
    frames //= -(-rate // 30)
    minutes, seconds = divmod(seconds, 60)
    hours, minutes = divmod(minutes, 60)
    return openexr().TimeCode(hours % 24, minutes, seconds, frames, *[0] * 14)


def _box(left: int, top: int, right: int, bottom: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([left, top], np.int32), np.array([right, bottom], np.int32)


def _row_vector_form(matrix: Float[np.ndarray, "4 4"]) -> Float32[np.ndarray, "4 4"]:
    """Return the transpose in memory too: OpenEXR copies an array's buffer and ignores its strides."""
    return np.ascontiguousarray(matrix.T, dtype=np.float32)
