"""Photographs and masks in a file each, as most captures hold them."""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from dsar.data.folders import Finder
from dsar.data.images.conversions import ConversionLog, Note
from dsar.data.images.decoding import CACHE, check_image_header, decode_mask_levels, decode_photograph
from dsar.data.images.distortion import undistort
from dsar.data.images.mask_encoding import MaskEncoding, detect_mask_encoding, sample_frames
from dsar.errors import CaptureError
from dsar.text import read_text
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
    conversions: ConversionLog = field(default_factory=lambda: ConversionLog("images"), compare=False)
    """Tells what is converted."""

    @cached_property
    def _finder(self) -> Finder:
        return Finder(self.root)

    @cached_property
    def _encodings(self) -> dict[str, MaskEncoding]:
        return {}

    def expected_files(self, camera: Camera) -> str:
        """Return where the first photograph and its mask should be, in words."""
        return " and ".join(map(str, self._patterns(camera, 0)))

    def has(self, camera: Camera, frame: int) -> bool:
        """Return whether a photograph and its mask are there."""
        return self._files(camera, frame) is not None

    def read(self, camera: Camera, frame: int) -> UInt8[np.ndarray, "h w 4"]:
        """Return an undistorted photograph with its mask as alpha, or raise CaptureError."""
        files = self._existing(camera, frame)

        def make() -> np.ndarray:
            rgba = self._decode(camera, *files)
            return undistort(rgba, camera, self.distortion.get(camera.name, ()))

        return CACHE.get((files, camera.name), make)

    def check_samples(self, cameras: Sequence[Camera]) -> None:
        """Look at the first photograph and some masks of each camera, and log what is converted.

        Raises:
            CaptureError: They are not what a camera's photographs and masks can be.
        """
        files_by_note: dict[tuple[str, Note], list[Path]] = defaultdict(list)
        for camera in cameras:
            frame = next(frame for frame in range(len(self.frames)) if self.has(camera, frame))
            color, mask = self._existing(camera, frame)
            for note in check_image_header(color, camera, str(color), mask):
                files_by_note["photographs", note].append(color)
            for note in self._encoding(camera).notes:
                files_by_note["masks", note].append(mask)
        for (kind, note), files in files_by_note.items():
            share = f" of {len(files)} of {len(cameras)} cameras"
            self.conversions.log(kind, [note], str(files[0]), share)

    def _decode(self, camera: Camera, color: Path, mask: Path) -> UInt8[np.ndarray, "h w 4"]:
        photograph = decode_photograph(color, camera, str(color), mask)
        levels = decode_mask_levels(mask, camera, color)
        self.conversions.log("photographs", photograph.notes, str(color))
        self.conversions.log("masks", levels.notes, str(mask))
        return np.dstack([photograph.color, self._encoding(camera).decode(levels, str(mask))])

    def _encoding(self, camera: Camera) -> MaskEncoding:
        """Return how a camera's masks are written: found once, from masks of all of the take."""
        if camera.name not in self._encodings:
            frames = [frame for frame in range(len(self.frames)) if self.has(camera, frame)]
            files = filter(None, (self._files(camera, frame) for frame in sample_frames(frames)))
            self._encodings[camera.name] = detect_mask_encoding(
                (partial(decode_mask_levels, mask, camera, color), str(mask)) for color, mask in files
            )
        return self._encodings[camera.name]

    def _files(self, camera: Camera, frame: int) -> tuple[Path, Path] | None:
        """Return a photograph and its mask, None unless both are there."""
        if (self.folders[camera.name], self.frames[frame]) in self.missing:
            return None
        color, mask = map(self._finder.find, self._patterns(camera, frame))
        return (color, mask) if color and mask else None

    def _existing(self, camera: Camera, frame: int) -> tuple[Path, Path]:
        files = self._files(camera, frame)
        if files is None:
            lacking = [path for path in self._patterns(camera, frame) if not self._finder.find(path)]
            raise CaptureError(f"image {lacking[0] if lacking else camera.name}: no such file")
        return files

    def _patterns(self, camera: Camera, frame: int) -> tuple[Path, Path]:
        names = {"camera": self.folders[camera.name], "frame": self.frames[frame]}
        return self.root / self.color.format(**names), self.root / self.mask.format(**names)


def read_missing_list(path: Path) -> frozenset[tuple[str, int]]:
    """Return the cameras and frames of a list of missing files, one path a line; empty without a list.

    Raises:
        CaptureError: a line does not end in CAMERA/FRAME.jpg.
    """
    missing = set()
    if not path.is_file():
        return frozenset()
    for number, line in enumerate(read_text(path, CaptureError).splitlines(), 1):
        parts = line.strip().replace("\\", "/").split("/")
        if parts == [""]:
            continue
        frame = parts[-1].partition(".")[0]
        if len(parts) < 2 or not frame.isdigit():
            raise CaptureError(f"{path}, line {number}: expected CAMERA/FRAME.jpg, found {line!r}")
        # Masks lie deeper: CAMERA/mask/pha/FRAME.jpg.
        camera = parts[-4] if len(parts) > 3 and parts[-3:-1] == ["mask", "pha"] else parts[-2]
        missing.add((camera, int(frame)))
    return frozenset(missing)
