"""Our cameras as Mitsuba's sensors.

Mitsuba: x left, y up, looking along +z; one field of view, so square pixels; the principal point as an
offset in shares of the film, positive to the left and up (measured). A camera with fx != fy is one with
square pixels whose image is taller by fx / fy.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from dsar.errors import ConfigError
from dsar.geometry.cameras import world_from_camera
from dsar.types import Camera

_NEAR, _FAR = 0.01, 1000.0
"""Metres."""


def square_pixels(camera: Camera) -> tuple[Camera, float]:
    """Return the view of a camera in square pixels, and how much taller its image is.

    Its image holds whole pixels, so it reaches up to one pixel below the camera's own.

    Raises:
        ConfigError: The camera's axes are skewed.
    """
    if camera.K[0, 1] != 0:
        raise ConfigError(
            f"camera {camera.name}: expected no skew (K[0][1] = 0), found {float(camera.K[0, 1]):g}: "
            "Mitsuba's cameras have none"
        )
    taller = float(camera.K[0, 0] / camera.K[1, 1])
    K = camera.K.clone()
    K[1] *= taller
    return dataclasses.replace(camera, K=K, height=math.ceil(camera.height * taller - 1e-6)), taller


def make_sensor(mi: Any, camera: Camera, samples: int = 1, unit: float = 1.0) -> dict[str, Any]:
    """Return a sensor for `mi.load_dict` with the view of a camera in square pixels.

    Pixels are the means of what falls into them (a box), in 32-bit floats.

    Args:
        mi: Mitsuba.
        camera: With fx = fy; see `square_pixels`.
        samples: Rays a pixel.
        unit: How many of the scene's units a metre has.
    """
    K = camera.K.double()
    to_world = world_from_camera(camera, "mitsuba")
    fx, cx, cy = float(K[0, 0]), float(K[0, 2]), float(K[1, 2])
    return {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f(mi.ScalarMatrix4f(to_world.tolist())),
        "fov_axis": "x",
        "fov": math.degrees(2 * math.atan(camera.width / (2 * fx))),
        "principal_point_offset_x": 0.5 - cx / camera.width,
        "principal_point_offset_y": 0.5 - cy / camera.height,
        "near_clip": _NEAR * unit,
        "far_clip": _FAR * unit,
        "sampler": {"type": "multijitter", "sample_count": samples},
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
    }


def pixel_centers(camera: Camera) -> Float[np.ndarray, "p 2"]:
    """Return the centres of a camera's pixels, row by row, as shares of the film of its square-pixel view."""
    square, taller = square_pixels(camera)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.stack([columns.ravel() / square.width, rows.ravel() * taller / square.height], -1)
