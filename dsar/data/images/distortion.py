"""Photographs of real lenses, turned into those of pinhole cameras."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8

from dsar.errors import CaptureError
from dsar.raster.jit import kernel
from dsar.types import Camera

COEFFICIENTS = 5
"""Numbers of a distortion: OpenCV's k1, k2, p1, p2, k3 (Brown 1971)."""


def parse_distortion(where: str, numbers: Any) -> tuple[float, ...]:
    """Return the coefficients k1, k2, p1, p2, k3 of a calibration; none and missing ones are zero.

    Raises:
        CaptureError: they are of another model, or no finite numbers.
    """
    flat = np.asarray(numbers, dtype=object).ravel().tolist()
    try:
        values = [float(number) for number in flat]
    except (TypeError, ValueError) as error:
        raise CaptureError(f"{where}: distCoeff is not made of numbers ({error})") from error
    if (len(values) > COEFFICIENTS and any(values[COEFFICIENTS:])) or not np.isfinite(values).all():
        raise CaptureError(
            f"{where}: expected distCoeff as k1, k2, p1, p2, k3, found {values}; undistort the images and "
            "set it to zeros"
        )
    return tuple((values + [0.0] * COEFFICIENTS)[:COEFFICIENTS])


def undistort(
    image: UInt8[np.ndarray, "h w c"], camera: Camera, distortion: Sequence[float]
) -> UInt8[np.ndarray, "h w c"]:
    """Return what a camera without distortion would have seen (bilinear; 0 beyond the image's edge).

    Args:
        image: As the lens drew it.
        camera: The calibration; its K holds for both images.
        distortion: k1, k2, p1, p2, k3.
    """
    if not any(distortion):
        return image
    K = camera.K.double().numpy()
    return _resample(image, K, np.linalg.inv(K), np.array(distortion, np.float64))


@kernel
def _resample(image, K, inverse, distortion):
    height, width, channels = image.shape
    k1, k2, p1, p2, k3 = distortion[0], distortion[1], distortion[2], distortion[3], distortion[4]
    out = np.zeros_like(image)
    for row in range(height):
        for column in range(width):
            u, v = column + 0.5, row + 0.5
            x = inverse[0, 0] * u + inverse[0, 1] * v + inverse[0, 2]
            y = inverse[1, 0] * u + inverse[1, 1] * v + inverse[1, 2]
            r = x * x + y * y
            radial = 1 + r * (k1 + r * (k2 + r * k3))
            bent_x = x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x)
            bent_y = y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y
            # Back to pixel centres at whole numbers, where values are.
            s = K[0, 0] * bent_x + K[0, 1] * bent_y + K[0, 2] - 0.5
            t = K[1, 0] * bent_x + K[1, 1] * bent_y + K[1, 2] - 0.5
            left, top = int(np.floor(s)), int(np.floor(t))
            if left < -1 or top < -1 or left >= width or top >= height:
                continue
            a, b = s - left, t - top
            for channel in range(channels):
                total = 0.0
                for down in range(2):
                    for right in range(2):
                        i, j = top + down, left + right
                        if 0 <= i < height and 0 <= j < width:
                            share = (a if right else 1 - a) * (b if down else 1 - b)
                            total += share * image[i, j, channel]
                out[row, column, channel] = np.uint8(total + 0.5)
    return out
