"""Images on disk: decoded, checked against their camera, and kept while there is room."""

import io
import struct
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from dsar.errors import CaptureError
from dsar.types import Camera

# What Pillow raises on damaged files of the formats that captures use.
_DAMAGE = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    LookupError,
    OverflowError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
    Image.DecompressionBombWarning,
)
ROOM = 1 << 28
"""Bytes of decoded images that a process keeps."""


def decode_rgba(data: bytes | Path, camera: Camera, where: str) -> UInt8[np.ndarray, "h w 4"]:
    """Return an image with its mask as alpha.

    Args:
        data: The file, or what is in it.
        camera: Whose size it must have.
        where: Names it in errors.

    Raises:
        CaptureError: It cannot be decoded, or is not 8-bit RGBA of the camera's size.
    """
    image = _decode(data, camera, where)
    if image.ndim != 3 or image.shape[2] != 4 or image.dtype != np.uint8:
        raise CaptureError(
            f"image {where}: expected 8-bit RGBA, found shape {image.shape} of {image.dtype}; the mask "
            "belongs into the alpha channel"
        )
    return image


def decode_photo(color: Path, mask: Path, camera: Camera) -> UInt8[np.ndarray, "h w 4"]:
    """Return a photograph with its mask from two files; a mask of several channels counts by its first.

    Raises:
        CaptureError: One cannot be decoded, is not 8-bit, or has not the camera's size.
    """
    rgba = np.empty((camera.height, camera.width, 4), np.uint8)
    rgba[..., :3] = _channels(color, camera)[..., :3]
    rgba[..., 3] = _channels(mask, camera)[..., 0]
    return rgba


def _channels(path: Path, camera: Camera) -> UInt8[np.ndarray, "h w c"]:
    """Return an image of one channel, or of three and more."""
    image = _decode(path, camera, str(path))
    if image.dtype == np.bool_:
        image = image * np.uint8(255)
    if image.dtype != np.uint8:
        raise CaptureError(f"image {path}: expected 8 bits a channel, found {image.dtype}")
    image = image if image.ndim == 3 else image[..., None]
    return image if image.shape[2] >= 3 else image[..., :1]


def _decode(data: bytes | Path, camera: Camera, where: str) -> np.ndarray:
    """Return an image as Pillow decodes it; one of another size is refused by its header."""
    try:
        with Image.open(io.BytesIO(data) if isinstance(data, bytes) else data) as image:
            size, pixels = image.size, None
            if size == (camera.width, camera.height):
                # Numbers of a palette's entries are no colours.
                pixels = np.asarray(image.convert("RGB") if image.mode == "P" else image)
    except _DAMAGE as error:
        raise CaptureError(f"image {where}: cannot be decoded ({error})") from error
    if pixels is None:
        raise CaptureError(
            f"image {where}: expected {camera.width}x{camera.height} pixels as camera {camera.name} says, "
            f"found {size[0]}x{size[1]}"
        )
    return pixels


class ImageCache:
    """The images that were used last, up to a limit of bytes; safe to share between threads."""

    def __init__(self, room: int = ROOM) -> None:
        self.room, self.used = room, 0
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
            if key not in self._images and image.nbytes <= self.room:
                self._images[key] = image
                self.used += image.nbytes
                while self.used > self.room:
                    self.used -= self._images.popitem(last=False)[1].nbytes
        return image


CACHE = ImageCache()
"""What all captures of this process share."""
