"""Which pixels of a picture an EXR holds: its data window within the display window."""

import numpy as np

from dsar.errors import ExportError
from dsar.types import Picture
from dsar_exporters.exr.header import Window


def check_size(picture: Picture) -> None:
    """Check that an image has the size of its camera and overscan.

    Raises:
        ExportError: It has not.
    """
    height, width = picture.output.alpha.shape
    camera, margin = picture.camera, 2 * picture.overscan
    if (width, height) != (camera.width + margin, camera.height + margin):
        raise ExportError(
            f"frame {picture.frame}: expected an image of {camera.width + margin}x{camera.height + margin} "
            f"from camera {camera.name}, found {width}x{height}: render with the camera that is passed"
        )


def data_window(picture: Picture, cropped: bool) -> tuple[Window, slice, slice]:
    """Return which pixels are written: in the display window's coordinates, and as rows and columns."""
    height, width = picture.output.alpha.shape
    top, bottom, left, right = 0, height, 0, width
    if cropped:
        hit = picture.output.alpha.numpy() > 0
        if not hit.any():
            # A file has to have a pixel.
            top, bottom, left, right = 0, 1, 0, 1
        else:
            top, bottom = _extent(np.flatnonzero(hit.any(axis=1)))
            left, right = _extent(np.flatnonzero(hit.any(axis=0)))
    margin = picture.overscan
    window = left - margin, top - margin, right - 1 - margin, bottom - 1 - margin
    return window, slice(top, bottom), slice(left, right)


def _extent(indices: np.ndarray) -> tuple[int, int]:
    """Return the first index, and the one after the last."""
    return int(indices[0]), int(indices[-1]) + 1
