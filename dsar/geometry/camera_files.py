"""Cameras in JSON, as our captures hold them (docs/capture-format.md), and such that move."""

import json
import logging
import math
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.atomic_files import atomic_write
from dsar.errors import ConfigError
from dsar.geometry.camera_paths import START_FRAME, CameraPath
from dsar.geometry.frame_rates import exact_rate, same_rate
from dsar.text import read_json
from dsar.types import Camera

_logger = logging.getLogger(__name__)

_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_FRAME = re.compile(r"-?\d+(\.\d+)?", re.ASCII)
_RIGID_TOLERANCE = 1e-4


def list_cameras_json(path: Path) -> list[str]:
    """Return the names of a file's cameras, whatever else is wrong with these.

    Raises:
        ConfigError: It cannot be read, or a name is no identifier or is there twice.
    """
    return list(_by_name(_load(path), path))


def read_cameras_json(
    path: Path, *, fps: float | None = None, chosen: Collection[str] | None = None
) -> list[CameraPath]:
    """Read cameras, in the file's order; a `capture.json` is such a file.

    `{"cameras": [{"name": ..., "K": ..., "T_camera_world": ..., "width": ..., "height": ...}]}`, with
    `"frames": {"1001": {"T_camera_world": ..., "K": ...}}` where a camera moves. What a frame does not say it
    takes from the camera. With `"fps": 24.0` beside `"cameras"` the file's frames are those of that rate,
    and are taken by seconds from frame 1001 on, which is the first at every rate.

    Args:
        path: The file.
        fps: Frames per second of the frame numbers that are wanted; None: the file's.
        chosen: Names of the cameras to read; others may be malformed. None: every one.

    Raises:
        ConfigError: It cannot be read, or its rate or a camera is incomplete or malformed.
    """
    record = _load(path)
    cameras = [
        _read_path(entry, where)
        for name, (where, entry) in _by_name(record, path).items()
        if chosen is None or name in chosen
    ]
    own = _rate(record, str(path))
    if own is None or fps is None or same_rate(own, fps):
        return cameras
    if any(camera.frames for camera in cameras):
        _logger.info("%s: its cameras move at %g frames a second; taken at %g by seconds", path, own, fps)
    return [_resampled(camera, float(exact_rate(fps) / exact_rate(own))) for camera in cameras]


def _load(path: Path) -> Mapping[str, Any]:
    """Return a file's record, which has a list of cameras."""
    record = read_json(path, ConfigError)
    entries = record.get("cameras") if isinstance(record, dict) else None
    if not isinstance(entries, list) or not entries:
        raise ConfigError(
            f'{path}: expected {{"cameras": [...]}} with at least one camera, found {_shown(record)}: write '
            "it as in docs/capture-format.md"
        )
    return record


def _by_name(record: Mapping[str, Any], path: Path) -> dict[str, tuple[str, Mapping[str, Any]]]:
    """Return how errors call each camera, and what the file says of it, by its name."""
    names, found = [], []
    for index, entry in enumerate(record["cameras"]):
        where = f"{path}, camera {index}"
        if not isinstance(entry, dict):
            raise ConfigError(
                f"{where}: expected name, K, T_camera_world, width and height, found {_shown(entry)}: "
                "correct it"
            )
        names.append(_checked_name(entry.get("name"), where))
        found.append((f"{where} {names[-1]}", entry))
    _refuse_doubled(names, str(path))
    return dict(zip(names, found, strict=True))


def write_cameras_json(paths: Sequence[CameraPath], path: Path) -> Path:
    """Write cameras as `read_cameras_json` reads them, to the last digit, and return the file's path.

    Raises:
        ConfigError: There is none, or a name is no identifier or is there twice.
    """
    names = [camera.name for camera in paths]
    if not names:
        raise ConfigError(f"{path}: expected cameras to write, found none: give at least one")
    for name in names:
        _checked_name(name, str(path))
    _refuse_doubled(names, str(path))
    with atomic_write(path) as draft:
        draft.write_text(cameras_to_json(paths))
    return path


def cameras_to_json(paths: Sequence[CameraPath]) -> str:
    """Return the text of a file of cameras, equal where they are equal: a line a camera or frame."""
    text = ",\n".join(_written(camera) for camera in paths)
    return f'{{"cameras": [\n{text}\n]}}\n'


def _written(path: CameraPath) -> str:
    first = path.cameras[0]
    record: dict[str, object] = {"name": first.name, "width": first.width, "height": first.height}
    record["K"] = first.K.tolist()
    if not path.frames:
        return json.dumps({**record, "T_camera_world": first.T_camera_world.tolist()})
    frames = []
    for frame, camera in zip(path.frames, path.cameras, strict=True):
        entry = {"T_camera_world": camera.T_camera_world.tolist()}
        if not torch.equal(camera.K, first.K):
            entry["K"] = camera.K.tolist()
        frames.append(f'  "{frame:.17g}": {json.dumps(entry)}')
    return f'{json.dumps(record)[:-1]}, "frames": {{\n' + ",\n".join(frames) + "\n}}"


def _read_path(entry: Mapping[str, Any], where: str) -> CameraPath:
    name = entry["name"]
    size = _size(entry, "width", where), _size(entry, "height", where)
    frames = entry.get("frames")
    if frames is None:
        return CameraPath((_read_camera(entry, name, size, where),))
    keyed = _keyed(frames, where)
    cameras = [
        _read_camera({**entry, **values}, name, size, f"{where}, frame {frame:.12g}")
        for frame, values in keyed.items()
    ]
    return CameraPath(tuple(cameras), tuple(keyed))


def _rate(record: Mapping[str, Any], where: str) -> float | None:
    """Return the frames per second of a file's frame numbers, if it says so."""
    rate = record.get("fps")
    if rate is not None and (type(rate) not in (int, float) or not 0 < rate < math.inf):
        raise ConfigError(f"{where}: expected fps as a number > 0, found {_shown(rate)}: correct it")
    return None if rate is None else float(rate)


def _resampled(path: CameraPath, ratio: float) -> CameraPath:
    """Return the camera with its keys at the same seconds of another rate, `ratio` times its own."""
    frames = tuple(START_FRAME + (frame - START_FRAME) * ratio for frame in path.frames)
    return CameraPath(path.cameras, frames)


def _keyed(frames: object, where: str) -> dict[float, Mapping[str, Any]]:
    """Return what a camera's `frames` say, by ascending frame number."""
    keyed: dict[float, Mapping[str, Any]] = {}
    for key, values in frames.items() if isinstance(frames, dict) else ():
        if not _FRAME.fullmatch(key) or float(key) in keyed or not isinstance(values, dict):
            raise ConfigError(
                f'{where}: expected frames as {{"1001": {{"T_camera_world": ...}}}}, each number once, found '
                f"{key!r}: {_shown(values)}: correct it"
            )
        keyed[float(key)] = values
    if not keyed:
        raise ConfigError(
            f"{where}: expected frames by number, at least one, found {_shown(frames)}: leave out `frames` "
            "for a camera at rest"
        )
    return dict(sorted(keyed.items()))


def _read_camera(entry: Mapping[str, Any], name: str, size: tuple[int, int], where: str) -> Camera:
    K, transform = _matrix(entry, "K", 3, where), _matrix(entry, "T_camera_world", 4, where)
    if not (K[0, 0] > 0 and K[1, 1] > 0 and K[1, 0] == 0 and K[2].tolist() == [0.0, 0.0, 1.0]):
        raise ConfigError(
            f"{where}: expected K as [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels, fx and fy > 0, found "
            f"{K.tolist()}: correct it"
        )
    rotation = transform[:3, :3].double()
    error = float((rotation @ rotation.T - torch.eye(3).double()).abs().max())
    turn = float(torch.linalg.det(rotation))
    if error > _RIGID_TOLERANCE or turn < 0 or transform[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise ConfigError(
            f"{where}: expected T_camera_world as a rotation, a translation and a last row 0 0 0 1, "
            f"found rows off orthonormal by {error:.1e}, determinant {turn:.3f} and last row "
            f"{transform[3].tolist()}: take scale and mirroring out"
        )
    return Camera(K, transform, *size, name)


def _matrix(entry: Mapping[str, Any], key: str, size: int, where: str) -> Float[Tensor, "n n"]:
    value = entry.get(key)
    try:
        matrix = torch.tensor(value, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        matrix = torch.empty(0)
    if matrix.shape != (size, size) or not bool(matrix.isfinite().all()):
        raise ConfigError(
            f"{where}: expected {key} as a {size}x{size} list of finite numbers, found {_shown(value)}: "
            "write it as in docs/capture-format.md"
        )
    return matrix


def _size(entry: Mapping[str, Any], key: str, where: str) -> int:
    value = entry.get(key)
    if type(value) is not int or value < 1:
        raise ConfigError(f"{where}: expected {key} in pixels, a whole number > 0, found {_shown(value)}")
    return value


def _checked_name(name: object, where: str) -> str:
    if not isinstance(name, str) or not _IDENTIFIER.fullmatch(name):
        raise ConfigError(
            f"{where}: expected a name of letters, digits and _ (no leading digit), found {_shown(name)}: "
            "rename the camera"
        )
    return name


def _refuse_doubled(names: Sequence[str], where: str) -> None:
    if doubled := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(
            f"{where}: expected names that differ, found {', '.join(doubled)} twice: rename one"
        )


def _shown(value: object) -> str:
    """Return what was found, short enough for a message."""
    text = repr(value)
    return text if len(text) <= 100 else f"{text[:97]}..."
