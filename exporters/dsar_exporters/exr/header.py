"""What an EXR's header says of camera, time, colour and origin (OpenEXR's standard attributes)."""

from typing import Any

import numpy as np

from dsar.geometry.frame_rates import exact_rate
from dsar.types import Picture
from dsar_exporters.exr.camera_attributes import camera_attributes
from dsar_exporters.exr.openexr import require_openexr

NO_COLOR = "data"
"""The Color Interop Forum's id of what is no colour."""
Window = tuple[int, int, int, int]
"""Left, top, right and bottom pixel, inclusive, in the display window's coordinates."""


def make_header(picture: Picture, interop_id: str, window: Window, job_hash: str) -> dict[str, Any]:
    """Return the header of a part that shows one camera's picture.

    Args:
        picture: What is written.
        interop_id: Of the colour space of R, G and B; `NO_COLOR` of a file without them.
        window: Which pixels the file holds.
        job_hash: Hash of all that the file depends on; written as `dsar/job`.
    """
    camera = picture.camera
    left, top, right, bottom = window
    chromaticities = require_openexr().colorInteropIDToChromaticities(interop_id)
    return {
        "displayWindow": _box(0, 0, camera.width - 1, camera.height - 1),
        "dataWindow": _box(left, top, right, bottom),
        **camera_attributes(camera),
        **_time_attributes(picture),
        "cameraLabel": camera.name,
        "view": camera.name,
        "colorInteropID": interop_id,
        # For readers older than OpenEXR 3.4, which know nothing of the id.
        **({"chromaticities": chromaticities} if chromaticities else {}),
        "software": f"dsar {picture.provenance.get('dsar', '')}".strip(),
        **{f"dsar/{key}": value for key, value in picture.provenance.items()},
        **({"dsar/guarded": picture.guarded.describe()} if picture.guarded else {}),
        "dsar/frame": str(picture.frame),
        "dsar/job": job_hash,
    }


def _time_attributes(picture: Picture) -> dict[str, Any]:
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
    return require_openexr().TimeCode(hours % 24, minutes, seconds, frames, *[0] * 14)


def _box(left: int, top: int, right: int, bottom: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([left, top], np.int32), np.array([right, bottom], np.int32)
