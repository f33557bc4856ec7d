"""Photographs and masks in a file each, as most captures hold them."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from dsar.data.distortion import undistort
from dsar.data.images import CACHE, decode_photo
from dsar.errors import CaptureError
from dsar.types import Camera


@dataclass(frozen=True)
class Photos:
    """The photographs of a take; implements `Views`. An undistorted image is kept while there is room."""

    root: Path
    """Folder that the patterns start from."""
    color: str
    """Pattern of a photograph's path, of `{camera}` and `{frame}`."""
    mask: str
    """Pattern of its mask's."""
    frames: Sequence[int] | Sequence[str]
    """What the files' names call each frame."""
    folders: Mapping[str, str]
    """What the files call each of our cameras."""
    distortion: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """k1, k2, p1, p2, k3 of each of our cameras; none: no distortion."""
    missing: Collection[tuple[str, int | str]] = frozenset()
    """Cameras and frames, by the files' names, that are known to be missing or spoilt."""

    def paths(self, camera: Camera, frame: int) -> tuple[Path, Path]:
        """Return where a photograph and its mask should be."""
        names = {"camera": self.folders[camera.name], "frame": self.frames[frame]}
        return self.root / self.color.format(**names), self.root / self.mask.format(**names)

    def expected(self, camera: Camera) -> str:
        """Return where the first photograph and its mask should be, in words."""
        return " and ".join(map(str, self.paths(camera, 0)))

    def has(self, camera: Camera, frame: int) -> bool:
        """Return whether a photograph and its mask are there."""
        if (self.folders[camera.name], self.frames[frame]) in self.missing:
            return False
        return all(path.is_file() for path in self.paths(camera, frame))

    def read(self, camera: Camera, frame: int) -> UInt8[np.ndarray, "h w 4"]:
        """Return an undistorted photograph with its mask as alpha, or raise CaptureError."""
        color, mask = self.paths(camera, frame)
        for path in (color, mask):
            if not path.is_file():
                raise CaptureError(f"image {path}: no such file")

        def make() -> np.ndarray:
            return undistort(decode_photo(color, mask, camera), camera, self.distortion.get(camera.name, ()))

        return CACHE.get((color, camera.name), make)


def image_size(path: Path) -> tuple[int, int]:
    """Return the width and height that an image's header says.

    Raises:
        CaptureError: it is not there or no image.
    """
    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, UnidentifiedImageError) as error:
        raise CaptureError(f"image {path}: cannot be read ({error})") from error


def read_missing(path: Path) -> frozenset[tuple[str, int]]:
    """Return the cameras and frames of a list of missing files, one path a line; empty without a list.

    Raises:
        CaptureError: a line does not end in CAMERA/FRAME.jpg.
    """
    found = set()
    if not path.is_file():
        return frozenset()
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path}: cannot be read as text ({error})") from error
    for number, line in enumerate(text.splitlines(), 1):
        parts = line.strip().replace("\\", "/").split("/")
        if parts == [""]:
            continue
        frame = parts[-1].partition(".")[0]
        if len(parts) < 2 or not frame.isdigit():
            raise CaptureError(f"{path}, line {number}: expected CAMERA/FRAME.jpg, found {line!r}")
        # Masks lie deeper: CAMERA/mask/pha/FRAME.jpg.
        camera = parts[-4] if len(parts) > 3 and parts[-3:-1] == ["mask", "pha"] else parts[-2]
        found.add((camera, int(frame)))
    return frozenset(found)
