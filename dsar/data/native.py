"""Captures in our own format: a folder with a capture.json (docs/capture-format.md)."""

import io
import json
import logging
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from dsar.body.files import choose_body, load_body
from dsar.data.calibration import make_camera
from dsar.data.images import decode_rgba
from dsar.data.motion import read_motion
from dsar.data.multiview import MultiViewCapture, OneToMany
from dsar.errors import CaptureError
from dsar.types import Body, Camera, Motion

RECORD_NAME = "capture.json"
FORMAT, VERSION = "dsar-capture", 1
_SUFFIXES = (".webp", ".png")
T = TypeVar("T")
LOGGER = logging.getLogger(__name__)


class _Images:
    """Images of one sequence, in a folder or a zip, as CAMERA/FRAME.webp or .png; implements `Views`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # A zip stays open and its images are read one by one: all of them may not fit in memory.
        self.archive = None if path.is_dir() else _open_archive(path)
        names = self.archive.namelist() if self.archive else map(self._relative, path.glob("*/*"))
        self.names = frozenset(names)

    def has(self, camera: Camera, frame: int) -> bool:
        """Return whether there is such an image."""
        return self._find(camera, frame) is not None

    def read(self, camera: Camera, frame: int) -> UInt8[np.ndarray, "h w 4"]:
        """Return a decoded image, or raise CaptureError."""
        name = self._find(camera, frame)
        if name is None:
            raise CaptureError(f"images {self.path}: no {camera.name}/{frame:04d}.webp or .png")
        return decode_rgba(self._load(name), camera, f"{name} in {self.path}")

    def check(self, cameras: Sequence[Camera], frames: int) -> None:
        """Raise CaptureError unless every camera has images, and the first of them the right size."""
        for camera in cameras:
            there = [frame for frame in range(frames) if self.has(camera, frame)]
            if not there:
                raise CaptureError(
                    f"images {self.path}: {camera.name} has none of {frames} frames; expected "
                    f"{camera.name}/0000.webp or .png and so on; add them, or take the camera out of "
                    f"{RECORD_NAME}"
                )
            if len(there) < frames:
                gap = min(set(range(frames)) - set(there))
                LOGGER.warning(
                    "Images %s: %s lacks %d of %d frames, the first is %d; it does without them",
                    *(self.path, camera.name, frames - len(there), frames, gap),
                )
            self._check_size(camera, str(self._find(camera, there[0])))

    def _find(self, camera: Camera, frame: int) -> str | None:
        names = (f"{camera.name}/{frame:04d}{suffix}" for suffix in _SUFFIXES)
        return next((name for name in names if name in self.names), None)

    def _load(self, name: str) -> bytes:
        try:
            return self.archive.read(name) if self.archive else (self.path / name).read_bytes()
        except (OSError, zipfile.BadZipFile, zlib.error) as error:
            raise CaptureError(f"image {name} in {self.path}: cannot be read ({error})") from error

    def _relative(self, path: Path) -> str:
        return path.relative_to(self.path).as_posix()

    def _check_size(self, camera: Camera, name: str) -> None:
        """Read no more of an image than its header."""
        try:
            with Image.open(io.BytesIO(self._load(name))) as image:
                size, mode = image.size, image.mode
        except (OSError, UnidentifiedImageError) as error:
            raise CaptureError(f"image {name} in {self.path}: cannot be decoded ({error})") from error
        if size != (camera.width, camera.height) or mode != "RGBA":
            raise CaptureError(
                f"image {name} in {self.path}: expected RGBA of {camera.width}x{camera.height} as "
                f"{camera.name} in {RECORD_NAME}, found {mode} of {size[0]}x{size[1]}"
            )


def _open_archive(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except (OSError, zipfile.BadZipFile) as error:
        raise CaptureError(f"images {path}: expected a folder or a zip file ({error})") from error


def open_native(root: Path, body: Path | None = None) -> MultiViewCapture:
    """Return the capture in a folder, checked for completeness.

    Args:
        root: The folder with its capture.json.
        body: A body-model file instead of the capture's own, or a folder of which the neutral is taken.

    Raises:
        CaptureError: Something is missing or malformed; the message names it.
        MotionError: A motion file is malformed.
        BodyError: The body-model file is.
    """
    where = root / RECORD_NAME
    record = _read_record(where)
    cameras = [
        _read_camera(entry, f"{where}, camera {k}")
        for k, entry in enumerate(_get(record, "cameras", list, where))
    ]
    names = [camera.name for camera in cameras]
    if not cameras or len(set(names)) != len(names):
        raise CaptureError(f"{where}: expected at least one camera and names that differ, found {names}")
    fps = float(_get(record, "fps", (int, float), where))
    sequences: dict[str, dict[str, Any]] = _get(record, "sequences", dict, where)
    splits = _read_splits(sequences, where)
    pairs = tuple(_read_pair(entry, sequences, where) for entry in record.get("one_to_many", []))
    images = {}
    for name, entry in sequences.items():
        images[name] = _Images(root / _get(entry, "images", str, f"{where}, sequence {name}"))
        images[name].check(cameras, _get(entry, "frames", int, f"{where}, sequence {name}"))
    recorded = root / record["body"] if record.get("body") else None
    body_path = choose_body(body, "neutral") if body else recorded
    if body_path != recorded:
        LOGGER.warning(
            "Capture %s: shape and motion were fitted with %s; with %s they may be centimetres off",
            *(root, recorded or "the embedded body", body_path),
        )
    betas = torch.tensor(_get(record, "betas", list, where), dtype=torch.float32)
    shaped = load_body(body_path, betas if len(betas) else None)
    return MultiViewCapture(
        root=root,
        name=_get(record, "name", str, where),
        fps=fps,
        cameras=tuple(cameras),
        body=shaped,
        body_path=body_path,
        betas=betas,
        motions={
            name: _read_sequence_motion(root, name, entry, shaped, fps) for name, entry in sequences.items()
        },
        splits=splits,
        one_to_many=pairs,
        views=images,
        reopen=partial(open_native, root, body),
        garments={name: root / entry["garment"] for name, entry in sequences.items() if entry.get("garment")},
    )


def _read_record(where: Path) -> dict[str, Any]:
    try:
        record = json.loads(where.read_text())
    except (OSError, ValueError) as error:
        raise CaptureError(f"{where}: cannot be read as JSON ({error})") from error
    found = (record.get("format"), record.get("version")) if isinstance(record, dict) else (None, None)
    if found != (FORMAT, VERSION):
        raise CaptureError(
            f"{where}: expected format {FORMAT!r} version {VERSION}, found {found[0]!r} version {found[1]!r}"
        )
    return record


def _get(record: Mapping[str, Any], key: str, kind: type[T] | tuple[type[T], ...], where: object) -> T:
    """Return a field of the right JSON type, or raise CaptureError."""
    value = record.get(key)
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        expected = " or ".join(k.__name__ for k in kinds)
        raise CaptureError(f"{where}: expected {key!r} as {expected}, found {value!r}")
    return value


def _read_camera(entry: Mapping[str, Any], where: str) -> Camera:
    name = _get(entry, "name", str, where)
    if not (name.isascii() and name.isidentifier()):
        raise CaptureError(f"{where}: expected a name of letters, digits and _, found {name!r}")
    matrices = {key: _get(entry, key, list, where) for key in ("K", "T_camera_world")}
    size = _get(entry, "width", int, where), _get(entry, "height", int, where)
    return make_camera(f"{where} {name}", name, matrices["K"], matrices["T_camera_world"], size)


def _read_sequence_motion(root: Path, name: str, entry: Mapping[str, Any], body: Body, fps: float) -> Motion:
    where = f"{root / RECORD_NAME}, sequence {name}"
    path = root / _get(entry, "motion", str, where)
    motion, frames = read_motion(path, body, up="z"), _get(entry, "frames", int, where)
    if len(motion) != frames or motion.fps != fps:
        raise CaptureError(
            f"{where}: expected {frames} frames at {fps:g} a second, found {len(motion)} at {motion.fps:g} "
            f"in {path}"
        )
    return Motion(motion.rotations, motion.translations, motion.fps, name)


def _read_splits(sequences: Mapping[str, Mapping[str, Any]], where: Path) -> dict[str, tuple[str, ...]]:
    splits: dict[str, list[str]] = {"train": [], "test": []}
    for name, entry in sequences.items():
        split = entry.get("split")
        if split not in ("train", "test"):
            raise CaptureError(f"{where}, sequence {name}: expected split train or test, found {split!r}")
        for label in (split, *entry.get("labels", [])):
            splits.setdefault(label, []).append(name)
    return {label: tuple(names) for label, names in splits.items()}


def _read_pair(
    entry: Mapping[str, Any], sequences: Mapping[str, Mapping[str, Any]], where: Path
) -> OneToMany:
    name = _get(entry, "sequence", str, f"{where}, one_to_many")
    if name not in sequences:
        raise CaptureError(f"{where}, one_to_many: no sequence {name!r}; there are {', '.join(sequences)}")
    frames = _get(sequences[name], "frames", int, f"{where}, sequence {name}")
    ranges = [tuple(_get(entry, key, list, f"{where}, one_to_many")) for key in ("after_stop", "at_rest")]
    for first, last in ranges:
        if not 0 <= first <= last < frames:
            raise CaptureError(f"{where}, one_to_many: {name} has {frames} frames, found {first}-{last}")
    return OneToMany(name, *ranges)
