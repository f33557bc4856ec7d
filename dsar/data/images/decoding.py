"""Images on disk: decoded, checked against their camera, and kept while there is room."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path

import numpy as np

from dsar.data.images.conversions import Note
from dsar.data.images.pixels import (
    MaskLevels,
    Photograph,
    apply_orientation,
    check_orientation,
    check_photograph_mode,
    displayed_size,
    open_image,
    read_mask_levels,
    read_photograph,
)
from dsar.errors import CaptureError
from dsar.types import Camera

CACHE_BYTES = 1 << 28
"""Bytes of decoded images that a process keeps."""


def decode_photograph(data: bytes | Path, camera: Camera, where: str, mask: Path | None = None) -> Photograph:
    """Return a photograph as sRGB of its camera's size.

    Args:
        data: The file, or what is in it.
        camera: Whose size it must have.
        where: Names it in errors.
        mask: The file of its mask; None: its alpha is, and it must have one.

    Raises:
        CaptureError: It cannot be decoded, is of a kind that no photograph is, or has another size.
    """
    with open_image(data, where) as image:
        _refuse_size(displayed_size(image), image.size, camera, where, "mask", mask)
        orientation_notes = check_orientation(image, (camera.width, camera.height))
        image = apply_orientation(image, (camera.width, camera.height))
        photograph = read_photograph(image, where)
        if mask is None and photograph.alpha is None:
            raise CaptureError(_no_alpha(where, image.mode))
    return Photograph(photograph.color, photograph.alpha, (*orientation_notes, *photograph.notes))


def decode_mask_levels(path: Path, camera: Camera, photograph: Path | None = None) -> MaskLevels:
    """Return a mask's numbers; their meaning is its camera's `MaskEncoding`.

    Args:
        path: The file.
        camera: Whose size it must have.
        photograph: What it is the mask of.

    Raises:
        CaptureError: It cannot be decoded, is no mask, or has another size.
    """
    with open_image(path, str(path)) as image:
        _refuse_size(displayed_size(image), image.size, camera, str(path), "photograph", photograph)
        orientation_notes = check_orientation(image, (camera.width, camera.height))
        image = apply_orientation(image, (camera.width, camera.height))
        levels = read_mask_levels(image, str(path))
    return MaskLevels(levels.values, (*orientation_notes, *levels.notes))


def check_image_header(
    data: bytes | Path, camera: Camera, where: str, mask: Path | None = None
) -> list[Note]:
    """Return what `decode_photograph` will convert, or raise what it will, without reading all pixels."""
    with open_image(data, where) as image:
        _refuse_size(displayed_size(image), image.size, camera, where, "mask", mask)
        if mask is None and not image.has_transparency_data:
            raise CaptureError(_no_alpha(where, image.mode))
        return [
            *check_orientation(image, (camera.width, camera.height)),
            *check_photograph_mode(image, where),
        ]


def _refuse_size(
    shown: tuple[int, int],
    stored: tuple[int, int],
    camera: Camera,
    where: str,
    kind: str,
    other: Path | None,
) -> None:
    """Raise CaptureError unless an image has its camera's size, as viewers show it or as it is stored."""
    size = camera.width, camera.height
    if size in (shown, stored):
        return
    ratio = size[0] / shown[0]
    if shown == size[::-1]:
        hint = "; they are turned by a quarter: turn the images, or calibrate them as they are"
    elif abs(shown[1] * ratio - size[1]) < max(1.0, ratio):
        hint = (
            f"; it is the same picture at {1 / ratio:.4g} times the size: give images of the calibration's "
            f"size, or multiply the calibration's size and K's first two rows by {1 / ratio:.4g}"
        )
    else:
        hint = "; it is another camera's, or was cut"
    if other is not None:
        hint += f" (its {kind} has {_size_in_words(other)})"
    raise CaptureError(
        f"image {where}: expected {size[0]}x{size[1]} pixels as camera {camera.name} says, found "
        f"{shown[0]}x{shown[1]}{hint}"
    )


def _size_in_words(path: Path) -> str:
    try:
        return "{}x{}".format(*image_size(path))
    except CaptureError:
        return "none that can be read"


def image_size(path: Path) -> tuple[int, int]:
    """Return the width and height of an image as viewers show it.

    Raises:
        CaptureError: it is not there or no image.
    """
    with open_image(path, str(path)) as image:
        return displayed_size(image)


def _no_alpha(where: str, mode: str) -> str:
    return f"image {where}: expected RGBA, found {mode}; the mask belongs into the alpha channel"


class ImageCache:
    """The images that were used last, up to a limit of bytes; safe to share between threads."""

    def __init__(self, capacity: int = CACHE_BYTES) -> None:
        self.capacity, self.used = capacity, 0
        self._images: OrderedDict[Hashable, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], np.ndarray]) -> np.ndarray:
        """Return the image of a key, made now unless it is kept; it must not be written to."""
        with self._lock:
            if key in self._images:
                self._images.move_to_end(key)
                return self._images[key]
        image = make()
        image.flags.writeable = False
        with self._lock:
            if key not in self._images and image.nbytes <= self.capacity:
                self._images[key] = image
                self.used += image.nbytes
                while self.used > self.capacity:
                    self.used -= self._images.popitem(last=False)[1].nbytes
        return image


CACHE = ImageCache()
"""What all captures of this process share."""
