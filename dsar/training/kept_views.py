"""Training images, decoded once and kept without what is transparent in them.

Every image is wanted several times in a run, and decoding one costs as much as half an image's rendering. A
person fills a sixth of a typical image, so that thousands of images fit into the room of a few hundred.
"""

import threading
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from dsar.metrics.images import mask_box
from dsar.raster.jit import kernel
from dsar.types import Capture

CAPACITY = 1 << 28
"""Bytes of images that a worker keeps."""
_SAMPLES = 16
"""Images that say how large the person is in others."""


@dataclass(frozen=True)
class PackedView:
    """An image without its transparent pixels."""

    runs: Int32[np.ndarray, "r 3"]
    """Row, first column and end column of each stretch of pixels that are not transparent."""
    pixels: UInt8[np.ndarray, "k 4"]
    """Straight sRGB and alpha of these pixels, stretch by stretch."""
    box: tuple[int, int, int, int]
    """What `mask_box` says without a margin."""

    @classmethod
    def of_image(cls, image: UInt8[np.ndarray, "h w 4"]) -> "PackedView":
        """Return an image packed."""
        runs, pixels = _pack(image)
        return cls(runs, pixels, mask_box(image[..., 3], 0))

    @property
    def nbytes(self) -> int:
        """Bytes of memory."""
        return self.runs.nbytes + self.pixels.nbytes

    def premultiplied_means(
        self, x0: int, y0: int, x1: int, y1: int, n: int
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Return colour times alpha and alpha, averaged over n x n pixels, of blocks x0..x1-1, y0..y1-1."""
        return _premultiplied_means(self.runs, self.pixels, x0, y0, x1, y1, n)


class KeptViews:
    """The images of a capture, kept once they were read while there is room; safe to share between threads.

    None makes room for another: each is as likely as the next to be wanted again.
    """

    def __init__(self, capture: Capture, capacity: int = CAPACITY) -> None:
        self.capture, self.capacity, self.used = capture, capacity, 0
        self._views: dict[tuple[str, int, int], PackedView] = {}
        self._lock = threading.Lock()

    def read(self, sequence: str, frame: int, camera: int) -> PackedView:
        """Return an image.

        Raises:
            CaptureError: it is not there, or cannot be decoded.
        """
        key = sequence, frame, camera
        view = self._views.get(key)
        if view is None:
            view = PackedView.of_image(self.capture.image(*key))
            with self._lock:
                if key not in self._views and self.used + view.nbytes <= self.capacity:
                    self._views[key] = view
                    self.used += view.nbytes
        return view


def kept_bytes(capture: Capture) -> int:
    """Return the bytes of images that a worker keeps at most, while it trains on a capture."""
    pixels = sum(camera.width * camera.height for camera in capture.cameras)
    frames = sum(len(capture.motions[name]) for name in capture.splits["train"])
    return min(CAPACITY, 4 * pixels * frames)


def largest_crop(capture: Capture, margin: int) -> tuple[int, int]:
    """Return height and width, pixels, that hold the person with a margin in each of a few training images.

    They are spread over frames and cameras. Without an image it is one of the margin alone.
    """
    frames = [(name, k) for name in capture.splits["train"] for k in range(len(capture.motions[name]))]
    height, width = 2 * margin, 2 * margin
    for turn, place in enumerate(range(0, len(frames), -(-len(frames) // _SAMPLES))):
        name, frame = frames[place]
        if cameras := capture.cameras_with_image(name, frame):
            alpha = capture.image(name, frame, cameras[turn % len(cameras)])[..., 3]
            x0, y0, x1, y1 = mask_box(alpha, margin)
            height, width = max(height, y1 - y0), max(width, x1 - x0)
    return height, width


@kernel
def _pack(image):
    """Return the stretches of pixels that are not transparent, and these pixels."""
    height, width = image.shape[0], image.shape[1]
    stretches, count = 0, 0
    for y in range(height):
        inside = False
        for x in range(width):
            visible = image[y, x, 3] > 0
            stretches += visible and not inside
            count += visible
            inside = visible
    runs, pixels = np.empty((stretches, 3), np.int32), np.empty((count, 4), np.uint8)
    stretch, k = -1, 0
    for y in range(height):
        inside = False
        for x in range(width):
            visible = image[y, x, 3] > 0
            if visible:
                if not inside:
                    stretch += 1
                    runs[stretch, 0], runs[stretch, 1] = y, x
                runs[stretch, 2] = x + 1
                for c in range(4):
                    pixels[k, c] = image[y, x, c]
                k += 1
            inside = visible
    return runs, pixels


@kernel
def _premultiplied_means(runs, pixels, x0, y0, x1, y1, n):
    """Return means over blocks of n x n pixels; sums are of integers, so no order of them rounds."""
    height, width = y1 - y0, x1 - x0
    sums = np.zeros((height, width, 4), np.int64)
    k = 0
    for r in range(len(runs)):
        first, end = runs[r, 1], runs[r, 2]
        y = runs[r, 0] // n - y0
        if y < 0 or y >= height:
            k += end - first
            continue
        x, left = first // n - x0, n - first % n
        for _ in range(first, end):
            if 0 <= x < width:
                a = np.int64(pixels[k, 3])
                sums[y, x, 0] += a * pixels[k, 0]
                sums[y, x, 1] += a * pixels[k, 1]
                sums[y, x, 2] += a * pixels[k, 2]
                sums[y, x, 3] += a
            k += 1
            left -= 1
            if left == 0:
                x, left = x + 1, n
    color, alpha = np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32)
    per_alpha, per_color = np.float32(1 / (255 * n * n)), np.float32(1 / (255 * 255 * n * n))
    for y in range(height):
        for x in range(width):
            for c in range(3):
                color[y, x, c] = sums[y, x, c] * per_color
            alpha[y, x] = sums[y, x, 3] * per_alpha
    return color, alpha
