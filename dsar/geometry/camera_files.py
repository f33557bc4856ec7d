"""Cameras in JSON, as our captures hold them (docs/capture-format.md), and such that move."""

import json
import logging
import math
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from dsar.atomic_files import atomic_write
from dsar.errors import ConfigError
from dsar.geometry.camera_checks import check_name, check_names_differ, make_camera, quote_value
from dsar.geometry.camera_paths import START_FRAME, CameraPath
from dsar.geometry.frame_rates import exact_rate, same_rate
from dsar.text import read_json
from dsar.types import Camera

_logger = logging.getLogger(__name__)

_FRAME = re.compile(r"-?\d+(\.\d+)?", re.ASCII)


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
            f'{path}: expected {{"cameras": [...]}} with at least one camera, found '
            f"{quote_value(record)}: write it as in docs/capture-format.md"
        )
    return record


def _by_name(record: Mapping[str, Any], path: Path) -> dict[str, tuple[str, Mapping[str, Any]]]:
    """Return how errors call each camera, and what the file says of it, by its name."""
    names, entries = [], []
    for index, entry in enumerate(record["cameras"]):
        where = f"{path}, camera {index}"
        if not isinstance(entry, dict):
            raise ConfigError(
                f"{where}: expected name, K, T_camera_world, width and height, found {quote_value(entry)}: "
                "correct it"
            )
        names.append(check_name(where, entry.get("name"), ConfigError))
        entries.append((f"{where} {names[-1]}", entry))
    check_names_differ(str(path), names, ConfigError)
    return dict(zip(names, entries, strict=True))


def write_cameras_json(paths: Sequence[CameraPath], path: Path) -> Path:
    """Write cameras as `read_cameras_json` reads them, to the last digit, and return the file's path.

    Raises:
        ConfigError: There is none, or a name is no identifier or is there twice.
    """
    names = [camera.name for camera in paths]
    if not names:
        raise ConfigError(f"{path}: expected cameras to write, found none: give at least one")
    for name in names:
        check_name(str(path), name, ConfigError)
    check_names_differ(str(path), names, ConfigError)
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
    frames = entry.get("frames")
    if frames is None:
        return CameraPath((_read_camera(where, entry, entry),))
    keyed = _keyed(frames, where)
    cameras = [
        _read_camera(f"{where}, frame {frame:.12g}", entry, {**entry, **keys})
        for frame, keys in keyed.items()
    ]
    return CameraPath(tuple(cameras), tuple(keyed))


def _rate(record: Mapping[str, Any], where: str) -> float | None:
    """Return the frames per second of a file's frame numbers, if it says so."""
    rate = record.get("fps")
    if rate is not None and (type(rate) not in (int, float) or not 0 < rate < math.inf):
        raise ConfigError(f"{where}: expected fps as a number > 0, found {quote_value(rate)}: correct it")
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
                f"{key!r}: {quote_value(values)}: correct it"
            )
        keyed[float(key)] = values
    if not keyed:
        raise ConfigError(
            f"{where}: expected frames by number, at least one, found {quote_value(frames)}: leave out "
            "`frames` for a camera at rest"
        )
    return dict(sorted(keyed.items()))


def _read_camera(where: str, entry: Mapping[str, Any], keys: Mapping[str, Any]) -> Camera:
    """Return a camera whose matrices are those of a key, name and size those of the entry."""
    K, T_camera_world = keys.get("K"), keys.get("T_camera_world")
    size = entry.get("width"), entry.get("height")
    return make_camera(where, entry["name"], K, T_camera_world, size, ConfigError)
