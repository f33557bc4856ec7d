"""Captures in our own format: a folder with a capture.json (docs/capture-format.md)."""

import logging
import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.body.files import choose_body, load_body
from dsar.data.captures.multiview import FILMED_SPLITS, UNSEEN_SPLITS, MultiViewCapture, OneToMany
from dsar.data.folders import check_name, find_file, inside
from dsar.data.images.conversions import ConversionLog
from dsar.data.images.cutouts import Cutouts
from dsar.data.motions.files import read_motion
from dsar.errors import CaptureError
from dsar.geometry.camera_checks import check_names_differ, make_camera
from dsar.geometry.frame_rates import same_rate
from dsar.text import read_json
from dsar.types import Body, Camera, Motion

RECORD_NAME = "capture.json"
FORMAT, VERSION = "dsar-capture", 1
_SPLITS = (*FILMED_SPLITS, *UNSEEN_SPLITS)
T = TypeVar("T")
LOGGER = logging.getLogger(__name__)


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
    where = find_file(root, RECORD_NAME)
    record = _read_record(where)
    cameras = [
        _read_camera(entry, f"{where}, camera {k}")
        for k, entry in enumerate(_get(record, "cameras", list, where))
    ]
    if not cameras:
        raise CaptureError(f"{where}: expected at least one camera, found none: add the calibrated cameras")
    check_names_differ(str(where), [camera.name for camera in cameras], CaptureError)
    fps = float(_get(record, "fps", (int, float), where))
    if not (math.isfinite(fps) and fps > 0):
        raise CaptureError(f"{where}: expected 'fps' as a number above 0, found {fps}")
    sequences: dict[str, dict[str, Any]] = _get(record, "sequences", dict, where)
    for name in sequences:
        check_name(f"{where}, sequences", name)
    splits = _read_splits(sequences, where)
    pairs = tuple(_read_pair(entry, sequences, where) for entry in record.get("one_to_many", []))
    label = _get(record, "name", str, where)
    images, garments = {}, _read_garments(root, sequences, where)
    conversions = ConversionLog(label)
    for name, entry in sequences.items():
        at = f"{where}, sequence {name}"
        if entry["split"] not in UNSEEN_SPLITS:
            images[name] = Cutouts(inside(at, root, _get(entry, "images", str, at)), conversions)
            images[name].check(cameras, _get(entry, "frames", int, at))
    recorded = inside(str(where), root, _get(record, "body", str, where)) if record.get("body") else None
    body_path = choose_body(body, "neutral") if body else recorded
    if body_path != recorded:
        LOGGER.warning(
            "Capture %s: shape and motion were fitted with %s; with %s they may be centimetres off",
            *(root, recorded or "the embedded body", body_path),
        )
    betas = _read_betas(_get(record, "betas", list, where), where)
    shaped = load_body(body_path, betas if len(betas) else None)
    return MultiViewCapture(
        root=root,
        name=label,
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
        garments=garments,
    )


def _read_record(where: Path) -> dict[str, Any]:
    record = read_json(where, CaptureError)
    fields = record if isinstance(record, dict) else {}
    kind, version = fields.get("format"), fields.get("version")
    if (kind, version) != (FORMAT, VERSION):
        raise CaptureError(
            f"{where}: expected format {FORMAT!r} version {VERSION}, found {kind!r} version {version!r}"
        )
    return record


def _get(record: Mapping[str, Any], key: str, kind: type[T] | tuple[type[T], ...], where: object) -> T:
    """Return a field of the right JSON type, or raise CaptureError."""
    value = record.get(key)
    # In Python, true is the whole number 1.
    if not isinstance(value, kind) or isinstance(value, bool):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        expected = " or ".join(k.__name__ for k in kinds)
        raise CaptureError(f"{where}: expected {key!r} as {expected}, found {value!r}")
    return value


def _read_camera(entry: Mapping[str, Any], where: str) -> Camera:
    if not isinstance(entry, dict):
        raise CaptureError(f"{where}: expected name, K, T_camera_world, width and height, found {entry!r}")
    K, T_camera_world = entry.get("K"), entry.get("T_camera_world")
    name, size = entry.get("name"), (entry.get("width"), entry.get("height"))
    return make_camera(f"{where} {name}", name, K, T_camera_world, size, CaptureError)


def _read_betas(numbers: list[Any], where: Path) -> Float[Tensor, " s"]:
    try:
        betas = torch.tensor(numbers, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        raise CaptureError(f"{where}: 'betas' is not a list of numbers ({error})") from error
    if betas.ndim != 1 or not bool(betas.isfinite().all()):
        raise CaptureError(f"{where}: expected 'betas' as a list of finite numbers, found {numbers}")
    return betas


def _read_sequence_motion(root: Path, name: str, entry: Mapping[str, Any], body: Body, fps: float) -> Motion:
    where = f"{root / RECORD_NAME}, sequence {name}"
    path = inside(where, root, _get(entry, "motion", str, where))
    # The format says which way is up: nothing was found that a user should know.
    motion = read_motion(path, body, up="z", level=logging.DEBUG)
    frames = _get(entry, "frames", int, where)
    if len(motion) != frames or not same_rate(motion.fps, fps):
        raise CaptureError(
            f"{where}: expected {frames} frames at {fps:.8g} a second, found {len(motion)} at "
            f"{motion.fps:.8g} in {path}"
        )
    # All sequences have the record's rate to the last digit, however their files round it.
    return Motion(motion.rotations, motion.translations, fps, name)


def _read_splits(sequences: Mapping[str, Mapping[str, Any]], where: Path) -> dict[str, tuple[str, ...]]:
    splits: dict[str, list[str]] = {split: [] for split in FILMED_SPLITS}
    for name, entry in sequences.items():
        split, labels = entry.get("split"), entry.get("labels", [])
        if split not in _SPLITS:
            expected = ", ".join(_SPLITS)
            raise CaptureError(
                f"{where}, sequence {name}: expected split as one of {expected}, found {split!r}"
            )
        if split in UNSEEN_SPLITS and (entry.get("images") is not None or labels):
            raise CaptureError(
                f"{where}, sequence {name}: expected no images and no labels of split {split}; write "
                '"images": null, or put it into split test'
            )
        if reserved := sorted(set(labels) & set(_SPLITS)):
            raise CaptureError(f"{where}, sequence {name}: {reserved[0]} is a split, not a label")
        for label in (split, *labels):
            splits.setdefault(label, []).append(name)
    return {label: tuple(names) for label, names in splits.items()}


def _read_garments(root: Path, sequences: Mapping[str, Mapping[str, Any]], where: Path) -> dict[str, Path]:
    """Return the files of the garment's truth, of the sequences that have one; unseen motions must."""
    garments = {}
    for name, entry in sequences.items():
        at, unseen = f"{where}, sequence {name}", entry["split"] in UNSEEN_SPLITS
        if entry.get("garment") or unseen:
            garments[name] = inside(at, root, _get(entry, "garment", str, at))
        if unseen and not garments[name].is_file():
            raise CaptureError(f"{at}: an unseen motion needs its garment; there is no {garments[name]}")
    return garments


def _read_pair(
    entry: Mapping[str, Any], sequences: Mapping[str, Mapping[str, Any]], where: Path
) -> OneToMany:
    name = _get(entry, "sequence", str, f"{where}, one_to_many")
    filmed = [each for each, entry in sequences.items() if entry["split"] not in UNSEEN_SPLITS]
    if name not in filmed:
        raise CaptureError(
            f"{where}, one_to_many: no sequence {name!r} with images; there are {', '.join(filmed)}"
        )
    frames = _get(sequences[name], "frames", int, f"{where}, sequence {name}")
    ranges = [tuple(_get(entry, key, list, f"{where}, one_to_many")) for key in ("after_stop", "at_rest")]
    for first, last in ranges:
        if not 0 <= first <= last < frames:
            raise CaptureError(f"{where}, one_to_many: {name} has {frames} frames, found {first}-{last}")
    return OneToMany(name, *ranges)
