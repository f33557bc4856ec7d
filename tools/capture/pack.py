"""Write the capture folder from the stages' results; docs/capture-format.md describes it."""

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from PIL import Image

from capture.choreography import OneToMany, Take
from capture.garment import Cut, grid_faces
from capture.subjects import Subject
from dsar.atomic_files import atomic_write, write_text_atomically
from dsar.data.motions.files import write_motion
from dsar.types import Body, Camera

GARMENT_UNIT = 0.001
"""Garment vertices are stored in whole millimetres."""


def write_capture(
    subject: Subject,
    out: Path,
    work: Path,
    body: Body,
    takes: Mapping[str, Take],
    cameras: Sequence[Camera],
    pairs: list[OneToMany],
) -> None:
    """Write capture.json, motion, images and garment of all takes under `out`.

    Args:
        subject: Who is dressed.
        out: The capture folder; made if need be.
        work: Where the simulation and the renderer left NAME.RUN.npy and NAME/CAMERA/FRAME.png.
        body: The embedded body.
        takes: Sequences by name.
        cameras: The rig.
        pairs: Frames of equal pose and different cloth.
    """
    for folder in ("motion", "images", "garment"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    for name, take in takes.items():
        write_motion(out / "motion" / f"{name}.npz", take.motion, body)
        _zip_images(out / "images" / f"{name}.zip", work / name, cameras, len(take.motion), subject.quality)
        _write_garment(subject.cut, out / "garment" / f"{name}.npz", sorted(work.glob(f"{name}.[0-9].npy")))
    record = {
        "format": "dsar-capture",
        "version": 1,
        "name": subject.name,
        "fps": next(iter(takes.values())).motion.fps,
        "cameras": [_describe_camera(camera) for camera in cameras],
        "body": None,
        "betas": [],
        "sequences": {name: _describe_take(name, take) for name, take in takes.items()},
        "one_to_many": [asdict(pair) for pair in pairs],
    }
    write_text_atomically(out / "capture.json", json.dumps(record, indent=1) + "\n")


def add_unseen(subject: Subject, out: Path, work: Path, body: Body, takes: Mapping[str, Take]) -> None:
    """Add motion and garment of takes without images to a capture; what it has keeps its bytes.

    Args:
        subject: Who is dressed.
        out: A capture folder that `write_capture` made.
        work: Where the simulation left NAME.RUN.npy.
        body: The embedded body.
        takes: Unseen motions by name; those that the capture has already are written anew.
    """
    for name, take in takes.items():
        write_motion(out / "motion" / f"{name}.npz", take.motion, body)
        _write_garment(subject.cut, out / "garment" / f"{name}.npz", sorted(work.glob(f"{name}.[0-9].npy")))
    record = json.loads((out / "capture.json").read_text())
    record["sequences"] |= {
        name: _describe_take(name, take) | {"images": None} for name, take in takes.items()
    }
    write_text_atomically(out / "capture.json", json.dumps(record, indent=1) + "\n")


def _describe_camera(camera: Camera) -> dict[str, object]:
    return {
        "name": camera.name,
        "K": camera.K.double().numpy().tolist(),
        "T_camera_world": camera.T_camera_world.double().numpy().tolist(),
        "width": camera.width,
        "height": camera.height,
    }


def _describe_take(name: str, take: Take) -> dict[str, object]:
    return {
        "motion": f"motion/{name}.npz",
        "images": f"images/{name}.zip",
        "frames": len(take.motion),
        "split": take.split,
        "labels": list(take.labels),
        "garment": f"garment/{name}.npz",
    }


def _zip_images(path: Path, folder: Path, cameras: Sequence[Camera], frames: int, quality: int) -> None:
    """Write the images of one sequence as an archive, unless it is there."""
    if path.exists():
        return
    with atomic_write(path) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_STORED) as archive:
        for camera in cameras:
            for frame in range(frames):
                entry = f"{camera.name}/{frame:04d}"
                with Image.open(folder / f"{entry}.png") as image:
                    data = _encode_webp(np.asarray(image), quality)
                # A fixed date keeps the archive's bytes reproducible.
                archive.writestr(zipfile.ZipInfo(f"{entry}.webp", (2026, 1, 1, 0, 0, 0)), data)


def _encode_webp(image: UInt8[ndarray, "h w 4"], quality: int) -> bytes:
    """Return the image as lossy WebP whose silhouette is not stained by what is behind it.

    WebP halves the resolution of colour: the colours are continued past the mask's edge first.
    """
    color, known = image[..., :3].astype(np.float32), image[..., 3] > 0
    for _ in range(4):
        total, count = np.zeros_like(color), np.zeros(known.shape, np.float32)
        for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
            near = np.roll(known, step, axis)
            total += np.roll(color, step, axis) * near[..., None]
            count += near
        grown = ~known & (count > 0)
        color[grown] = total[grown] / count[grown, None]
        known |= grown
    buffer = io.BytesIO()
    full = np.concatenate([np.round(color).astype(np.uint8), image[..., 3:]], -1)
    Image.fromarray(full).save(buffer, "WEBP", quality=quality, method=4)
    return buffer.getvalue()


def _write_garment(cut: Cut, path: Path, runs: list[Path]) -> None:
    """Write every run as int16 steps in time, of the rows up from the hem and the columns that are stored."""
    arrays: dict[str, Any] = {f"run{k}": _encode(cut, np.load(run)) for k, run in enumerate(runs)}
    arrays["faces"] = grid_faces(cut.rows // cut.stored[0], cut.columns // cut.stored[1])
    arrays["unit"] = np.float64(GARMENT_UNIT)
    with atomic_write(path) as draft, draft.open("wb") as file:
        np.savez_compressed(file, **arrays)


def _encode(cut: Cut, cloth: Float[ndarray, "f n 3"]) -> Int[ndarray, "f v 3"]:
    down, along = cut.stored
    grid = cloth.reshape(len(cloth), cut.rows, cut.columns, 3)[:, down - 1 :: down, ::along]
    levels = np.round(grid.reshape(len(cloth), -1, 3) / GARMENT_UNIT).astype(np.int16)
    return np.diff(levels, axis=0, prepend=np.zeros_like(levels[:1]))
