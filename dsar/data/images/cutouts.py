"""Images that bring their masks as alpha, in a folder or a zip: those of our own format."""

import logging
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import UInt8

from dsar.data.folders import list_folder, list_members
from dsar.data.images.conversions import ConversionLog
from dsar.data.images.decoding import check_image_header, decode_photograph
from dsar.data.images.mask_encoding import MaskEncoding, detect_mask_encoding, sample_frames
from dsar.data.images.pixels import MaskLevels, Photograph
from dsar.errors import CaptureError
from dsar.types import Camera

_SUFFIXES = (".webp", ".png")
LOGGER = logging.getLogger(__name__)


class Cutouts:
    """Images of one sequence, as CAMERA/FRAME.webp or .png; implements `Views`."""

    def __init__(self, path: Path, conversions: ConversionLog) -> None:
        self.path, self.conversions = path, conversions
        # A zip stays open and its images are read one by one: all of them may not fit in memory.
        self.archive = None if path.is_dir() else _open_archive(path)
        members = list_members(self.archive) if self.archive else _walk(path)
        self.names = dict(zip(map(_plain, _without_top(members)), members, strict=True))
        self._lengths: dict[str, int] = {}
        self._encodings: dict[str, MaskEncoding] = {}

    def has(self, camera: Camera, frame: int) -> bool:
        """Return whether there is such an image."""
        return self._find(camera, frame) is not None

    def read(self, camera: Camera, frame: int) -> UInt8[np.ndarray, "h w 4"]:
        """Return a decoded image, or raise CaptureError."""
        name = self._find(camera, frame)
        if name is None:
            raise CaptureError(f"images {self.path}: no {camera.name}/{frame:04d}.webp or .png")
        where, photograph = self._where(name), self._decode(camera, name)
        encoding = self._encoding(camera)
        self.conversions.log("images", photograph.notes, where)
        self.conversions.log("masks", encoding.notes, where)
        return np.dstack([photograph.color, encoding.decode(_alpha(photograph), where)])

    def check(self, cameras: Sequence[Camera], frames: int) -> None:
        """Raise CaptureError unless every camera has images, and the first of them can be one of its."""
        for camera in cameras:
            there = [frame for frame in range(frames) if self.has(camera, frame)]
            if not there:
                raise CaptureError(
                    f"images {self.path}: {camera.name} has none of {frames} frames; expected "
                    f"{camera.name}/0000.webp or .png and so on; add them, or take the camera out of "
                    "the capture's record"
                )
            if len(there) < frames:
                gap = min(set(range(frames)) - set(there))
                LOGGER.warning(
                    "Images %s: %s lacks %d of %d frames, the first is %d; it does without them",
                    *(self.path, camera.name, frames - len(there), frames, gap),
                )
            self._lengths[camera.name] = frames
            first = str(self._find(camera, there[0]))
            check_image_header(self._load(first), camera, self._where(first))

    def _encoding(self, camera: Camera) -> MaskEncoding:
        """Return how a camera's masks are written: found once, from images of all of the sequence."""
        if camera.name not in self._encodings:
            frames = range(self._lengths.get(camera.name, 0))
            names = (
                self._find(camera, frame)
                for frame in sample_frames([f for f in frames if self.has(camera, f)])
            )
            self._encodings[camera.name] = detect_mask_encoding(
                (lambda name=name: _alpha(self._decode(camera, name)), self._where(name))
                for name in filter(None, names)
            )
        return self._encodings[camera.name]

    def _decode(self, camera: Camera, name: str) -> Photograph:
        return decode_photograph(self._load(name), camera, self._where(name))

    def _find(self, camera: Camera, frame: int) -> str | None:
        names = (f"{camera.name}/{frame:04d}{suffix}" for suffix in _SUFFIXES)
        return next((self.names[name] for name in names if name in self.names), None)

    def _where(self, name: str) -> str:
        return f"{name} in {self.path}"

    def _load(self, name: str) -> bytes:
        try:
            return self.archive.read(name) if self.archive else (self.path / name).read_bytes()
        # A RuntimeError is an archive with a password, or packed in a way that Python does not know.
        except (OSError, zipfile.BadZipFile, zlib.error, RuntimeError) as error:
            raise CaptureError(f"image {self._where(name)}: cannot be read ({error})") from error


def _alpha(photograph: Photograph) -> MaskLevels:
    assert photograph.alpha is not None, "decoded as an image with its mask"
    return MaskLevels(photograph.alpha, ())


def _walk(root: Path) -> list[str]:
    def below(folder: Path) -> Iterator[Path]:
        for path in list_folder(folder):
            yield from below(path) if path.is_dir() else [path]

    return [path.relative_to(root).as_posix() for path in below(root)]


def _without_top(names: Sequence[str]) -> list[PurePosixPath]:
    """Return paths CAMERA/FRAME.png without the folders that all of them lie in, as packers add them."""
    paths = [PurePosixPath(name.replace("\\", "/")) for name in names]
    while (
        paths and all(len(path.parts) > 2 for path in paths) and len({path.parts[0] for path in paths}) == 1
    ):
        paths = [path.relative_to(path.parts[0]) for path in paths]
    return paths


def _plain(path: PurePosixPath) -> str:
    return str(path.with_suffix(path.suffix.lower()))


def _open_archive(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except (OSError, zipfile.BadZipFile) as error:
        raise CaptureError(f"images {path}: expected a folder or a zip file ({error})") from error
