"""Captures in our own format: a folder with a capture.json (docs/capture-format.md)."""

import dataclasses
import io
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from dsar.body.files import load_body
from dsar.body.model import Body
from dsar.data.motion import read_motion
from dsar.errors import CaptureError, ConfigError
from dsar.geometry.cameras import spread_out
from dsar.types import Camera, Motion

RECORD_NAME = "capture.json"
FORMAT, VERSION = "dsar-capture", 1
_SUFFIXES = (".webp", ".png")
_RIGID_TOLERANCE = 1e-4
T = TypeVar("T")


@dataclass(frozen=True)
class OneToMany:
    """Frames of one sequence in which the body's pose is the same and the cloth is not; ends included."""

    sequence: str
    after_stop: tuple[int, int]
    at_rest: tuple[int, int]


@dataclass(frozen=True)
class NativeCapture:
    """A capture in our own format; implements `dsar.types.Capture`.

    Images are held compressed and decoded on demand. Pickling sends only the folder's path: the other
    process opens the capture anew.
    """

    root: Path
    """The capture's folder."""
    name: str
    """Label of the capture."""
    fps: float
    """Frames per second of every sequence."""
    cameras: Sequence[Camera]
    """Calibrated cameras, the same for every frame."""
    body: Body
    """The person at rest, in the capture's shape."""
    body_path: Path | None
    """The body-model file; None is the embedded body."""
    betas: Float[Tensor, " s"]
    """Shape coefficients of the body."""
    motions: Mapping[str, Motion]
    """Body motion of each sequence, by sequence name, in the order of the file."""
    splits: Mapping[str, Sequence[str]]
    """Sequence names of `train` and `test` and of each label such as `nd`, `fd`."""
    one_to_many: Sequence[OneToMany]
    """Where equal poses with different cloth are to be found."""
    _images: Mapping[str, "_ImageSource"] = field(repr=False)
    _garments: Mapping[str, Path] = field(repr=False)

    def __reduce__(self) -> tuple[Callable[..., "NativeCapture"], tuple[Path, tuple[str, ...]]]:
        return _reopen, (self.root, tuple(camera.name for camera in self.cameras))

    def with_cameras(self, count: int | None) -> "NativeCapture":
        """Return the capture as seen by some of its cameras, spread as far as can be; None: by all."""
        if count is None:
            return self
        if not 1 <= count <= len(self.cameras):
            raise ConfigError(f"cameras is {count}; capture {self.name} has {len(self.cameras)}")
        return dataclasses.replace(self, cameras=spread_out(self.cameras, count))

    def image(self, sequence: str, frame: int, camera: int) -> UInt8[np.ndarray, "h w 4"]:
        """Return one image: straight (not premultiplied) sRGB and coverage as alpha.

        Raises:
            CaptureError: There is no such image, or it cannot be decoded or has the wrong size.
        """
        if sequence not in self.motions:
            raise CaptureError(
                f"capture {self.name}: no sequence {sequence!r}; there are {', '.join(self.motions)}"
            )
        view, frames = self.cameras[camera], len(self.motions[sequence])
        if not 0 <= frame < frames:
            raise CaptureError(
                f"capture {self.name}, {sequence}: no frame {frame}; there are 0 to {frames - 1}"
            )
        return self._images[sequence].read(view, frame)

    def garment(self, sequence: str, run: int = 0) -> Float[np.ndarray, "f v 3"]:
        """Return the simulated garment's true vertices, world metres.

        Args:
            sequence: Name of a sequence with garment truth.
            run: 0 is the run in the images; higher ones are other true outcomes of the same motion, begun
                from a slightly different state.

        Raises:
            CaptureError: The capture has no such truth.
        """
        steps = self._read_garment(sequence, f"run{run}")
        unit = self._read_garment(sequence, "unit")
        return (np.cumsum(steps.astype(np.int32), 0) * float(unit)).astype(np.float32)

    def garment_runs(self, sequence: str) -> int:
        """Return how many true outcomes of a sequence `garment` knows; 0 without garment truth."""
        path = self._garments.get(sequence)
        if path is None:
            return 0
        with np.load(path) as file:
            return sum(key.startswith("run") for key in file.files)

    def garment_faces(self, sequence: str) -> Int[np.ndarray, "t 3"]:
        """Return the triangles of the garment's vertices, counter-clockwise seen from outside."""
        return self._read_garment(sequence, "faces").astype(np.int64)

    def _read_garment(self, sequence: str, key: str) -> np.ndarray:
        path = self._garments.get(sequence)
        if path is None:
            known = ", ".join(self._garments) or "none"
            raise CaptureError(f"capture {self.name}: no garment truth for {sequence!r}; it has {known}")
        with np.load(path) as file:
            if key not in file.files:
                raise CaptureError(f"garment {path}: expected {key}, found {', '.join(file.files)}")
            return file[key]


@dataclass(frozen=True)
class _ImageSource:
    """Images of one sequence, in a folder or a zip, as CAMERA/FRAME.webp or .png."""

    path: Path

    def read(self, camera: Camera, frame: int) -> UInt8[np.ndarray, "h w 4"]:
        """Return a decoded image, or raise CaptureError."""
        entries = _read_entries(self.path)
        entry = self.find(entries, camera, frame)
        if entry is None:
            raise CaptureError(f"images {self.path}: no {camera.name}/{frame:04d}.webp or .png")
        try:
            image = np.asarray(Image.open(io.BytesIO(entries[entry])))
        except (OSError, UnidentifiedImageError) as error:
            raise CaptureError(f"image {entry} in {self.path}: cannot be decoded ({error})") from error
        expected = (camera.height, camera.width, 4)
        if image.shape != expected or image.dtype != np.uint8:
            raise CaptureError(
                f"image {entry} in {self.path}: expected 8-bit RGBA of {camera.width}x{camera.height}, found "
                f"shape {image.shape} of {image.dtype}; the mask belongs into the alpha channel"
            )
        return image

    @staticmethod
    def find(entries: Mapping[str, bytes] | set[str], camera: Camera, frame: int) -> str | None:
        """Return the name of an image among entries, or None."""
        names = (f"{camera.name}/{frame:04d}{suffix}" for suffix in _SUFFIXES)
        return next((name for name in names if name in entries), None)

    def check(self, cameras: Sequence[Camera], frames: int) -> None:
        """Raise CaptureError unless every camera has every frame and the first has the right size."""
        names = _list_entries(self.path)
        for camera in cameras:
            missing = [frame for frame in range(frames) if self.find(names, camera, frame) is None]
            if missing:
                raise CaptureError(
                    f"images {self.path}: {camera.name} lacks {len(missing)} of {frames} frames, the first "
                    f"is {camera.name}/{missing[0]:04d}.webp or .png; add them or lower `frames`"
                )
            self._check_size(camera, str(self.find(names, camera, 0)))

    def _check_size(self, camera: Camera, entry: str) -> None:
        """Read no more of an image than its header."""
        try:
            with Image.open(io.BytesIO(_read_entry(self.path, entry))) as image:
                size, mode = image.size, image.mode
        except (OSError, UnidentifiedImageError) as error:
            raise CaptureError(f"image {entry} in {self.path}: cannot be decoded ({error})") from error
        if size != (camera.width, camera.height) or mode != "RGBA":
            raise CaptureError(
                f"image {entry} in {self.path}: expected RGBA of {camera.width}x{camera.height} as "
                f"{camera.name} in {RECORD_NAME}, found {mode} of {size[0]}x{size[1]}"
            )


def _list_entries(path: Path) -> set[str]:
    if path.is_dir():
        return {item.relative_to(path).as_posix() for item in path.glob("*/*")}
    try:
        with zipfile.ZipFile(path) as archive:
            return set(archive.namelist())
    except (OSError, zipfile.BadZipFile) as error:
        raise CaptureError(f"images {path}: expected a folder or a zip file ({error})") from error


def _read_entry(path: Path, entry: str) -> bytes:
    if path.is_dir():
        return (path / entry).read_bytes()
    with zipfile.ZipFile(path) as archive:
        return archive.read(entry)


@cache
def _read_entries(path: Path) -> Mapping[str, bytes]:
    """Return all compressed images of a sequence; they stay in memory for the process's life."""
    if path.is_dir():
        return {item.relative_to(path).as_posix(): item.read_bytes() for item in path.glob("*/*")}
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def open_native(root: Path) -> NativeCapture:
    """Return the capture in a folder, checked for completeness.

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
        images[name] = _ImageSource(root / _get(entry, "images", str, f"{where}, sequence {name}"))
        images[name].check(cameras, _get(entry, "frames", int, f"{where}, sequence {name}"))
    body_path = root / record["body"] if record.get("body") else None
    betas = torch.tensor(_get(record, "betas", list, where), dtype=torch.float32)
    body = load_body(body_path, betas if len(betas) else None)
    return NativeCapture(
        root=root,
        name=_get(record, "name", str, where),
        fps=fps,
        cameras=tuple(cameras),
        body=body,
        body_path=body_path,
        betas=betas,
        motions={
            name: _read_sequence_motion(root, name, entry, body, fps) for name, entry in sequences.items()
        },
        splits=splits,
        one_to_many=pairs,
        _images=images,
        _garments={
            name: root / entry["garment"] for name, entry in sequences.items() if entry.get("garment")
        },
    )


def _reopen(root: Path, cameras: tuple[str, ...]) -> NativeCapture:
    """Return a capture as seen by the cameras of these names."""
    capture = open_native(root)
    return dataclasses.replace(capture, cameras=[c for c in capture.cameras if c.name in cameras])


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
    if not name.isidentifier():
        raise CaptureError(f"{where}: expected a name of letters, digits and _, found {name!r}")
    K = _read_matrix(entry, "K", 3, where)
    if not (K[0, 0] > 0 and K[1, 1] > 0 and torch.equal(K[2], torch.tensor([0.0, 0.0, 1.0]))):
        raise CaptureError(
            f"{where} {name}: expected K as [[fx, s, cx], [0, fy, cy], [0, 0, 1]], found {K.tolist()}"
        )
    transform = _read_matrix(entry, "T_camera_world", 4, where)
    rotation = transform[:3, :3].double()
    error = float((rotation @ rotation.T - torch.eye(3).double()).abs().max())
    last = torch.equal(transform[3], torch.tensor([0.0, 0.0, 0.0, 1.0]))
    if error > _RIGID_TOLERANCE or torch.linalg.det(rotation) < 0 or not last:
        raise CaptureError(
            f"{where} {name}: T_camera_world is not rigid (rows off orthonormal by {error:.1e}, "
            f"determinant {float(torch.linalg.det(rotation)):.3f}); expected a rotation, a translation and "
            "a last row 0 0 0 1"
        )
    return Camera(K, transform, _get(entry, "width", int, where), _get(entry, "height", int, where), name)


def _read_matrix(entry: Mapping[str, Any], key: str, size: int, where: str) -> Float[Tensor, "n n"]:
    value = _get(entry, key, list, where)
    try:
        matrix = torch.tensor(value, dtype=torch.float32)
    except (TypeError, ValueError) as error:
        raise CaptureError(f"{where}: {key} is not a {size}x{size} matrix of numbers ({error})") from error
    if matrix.shape != (size, size) or not bool(matrix.isfinite().all()):
        raise CaptureError(f"{where}: {key} is not a {size}x{size} matrix of finite numbers, found {value}")
    return matrix


def _read_sequence_motion(root: Path, name: str, entry: Mapping[str, Any], body: Body, fps: float) -> Motion:
    where = f"{root / RECORD_NAME}, sequence {name}"
    path = root / _get(entry, "motion", str, where)
    motion, frames = read_motion(path, body), _get(entry, "frames", int, where)
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
