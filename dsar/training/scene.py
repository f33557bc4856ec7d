"""What a run keeps of its capture: cameras and motions, all that drives the avatar, but no images.

RUN/scene.safetensors holds them to the last bit, so that a run can be moved, archived and rendered where the
capture is not.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from dsar.atomic_files import atomic_write
from dsar.body.model import JOINT_NAMES
from dsar.config import EMBEDDED_CAPTURES, TrainConfig
from dsar.data.captures.formats import capture_of
from dsar.data.captures.multiview import MultiViewCapture
from dsar.errors import CheckpointError
from dsar.training.checkpoint import Run, reading
from dsar.types import Camera, Motion

_FORMAT = "dsar-scene 1"
_SIZES = {"K": (3, 3), "T_camera_world": (4, 4), "rotations": (len(JOINT_NAMES), 3), "translations": (3,)}


@dataclass(frozen=True)
class Scene:
    """The cameras and motions of a capture."""

    name: str
    """The capture's."""
    cameras: tuple[Camera, ...]
    """All of them, also those that training left out."""
    motions: Mapping[str, Motion]
    """Body motion of each sequence, by sequence name."""
    splits: Mapping[str, Sequence[str]]
    """Sequence names of `train` and `test` and of each label such as `nd`, `fd`."""

    def is_of(self, other: "Scene") -> bool:
        """Return whether another scene has the same cameras, motions and splits, to the last bit."""
        mine, theirs = (_recorded(scene) for scene in (self, other))
        return mine[0] == theirs[0] and all(
            torch.equal(value, theirs[1][key]) for key, value in mine[1].items()
        )


def scene_of_capture(capture: MultiViewCapture) -> Scene:
    """Return the cameras and motions of a capture."""
    return Scene(capture.name, tuple(capture.cameras), capture.motions, capture.splits)


def open_scene(run: Run, config: TrainConfig) -> Scene:
    """Return the scene that a run keeps; for runs that were begun before they kept any, the capture's.

    Raises:
        CheckpointError: it is damaged, or not kept and the capture is gone.
        DsarError: the capture cannot be read.
    """
    if run.scene.exists():
        return read_scene(run.scene)
    if not _is_there(config):
        raise CheckpointError(
            f"{run.folder}: its capture {config.capture} is not there, and a run as old keeps no cameras and "
            "motions of its own; put the capture back, or give --motion FILE and, for cameras, --cameras FILE"
        )
    return scene_of_capture(capture_of(config))


def open_images(run: Run, config: TrainConfig) -> MultiViewCapture:
    """Return the capture of a run, for commands that compare with its images.

    Raises:
        CheckpointError: it is gone.
        DsarError: it cannot be read.
    """
    if not _is_there(config):
        raise CheckpointError(
            f"{run.folder}: its capture {config.capture} is not there, and this command compares with its "
            "images, which a run does not keep; put the capture back (export, render, stress and crosscheck "
            "do without)"
        )
    return capture_of(config)


def _is_there(config: TrainConfig) -> bool:
    return config.capture in EMBEDDED_CAPTURES or Path(config.capture).exists()


def _recorded(scene: Scene) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return what is written of a scene: names and numbers, and tensors."""
    record = {
        "format": _FORMAT,
        "name": scene.name,
        "cameras": [[camera.name, camera.width, camera.height] for camera in scene.cameras],
        "motions": [[name, motion.name, motion.fps] for name, motion in scene.motions.items()],
        "splits": {split: list(names) for split, names in scene.splits.items()},
    }
    tensors: dict[str, Tensor] = {}
    for number, camera in enumerate(scene.cameras):
        tensors |= {
            f"cameras.{number}.K": camera.K,
            f"cameras.{number}.T_camera_world": camera.T_camera_world,
        }
    for number, motion in enumerate(scene.motions.values()):
        tensors[f"motions.{number}.rotations"] = motion.rotations
        tensors[f"motions.{number}.translations"] = motion.translations
    return record, tensors


def write_scene(path: Path, scene: Scene) -> None:
    """Write a scene, whole or not at all."""
    record, tensors = _recorded(scene)
    # Parts of one sequence may share their memory; the file format wants each by itself.
    own = {
        key: tensor.detach().cpu().clone(memory_format=torch.contiguous_format)
        for key, tensor in tensors.items()
    }
    with atomic_write(path) as draft:
        save_file(own, draft, {"scene": json.dumps(record)})


def read_scene(path: Path) -> Scene:
    """Return what `write_scene` wrote.

    Raises:
        CheckpointError: the file is damaged, or something else.
    """
    with reading(path):
        with safe_open(path, "pt") as file:
            record = json.loads((file.metadata() or {})["scene"])
            tensors = {key: file.get_tensor(key).clone() for key in file.keys()}
        if record["format"] != _FORMAT:
            raise CheckpointError(
                f"{path}: expected {_FORMAT}, found {record['format']}: use its version of dsar"
            )
        for key, values in tensors.items():
            sizes = _SIZES[key.rpartition(".")[2]]
            if values.shape[-len(sizes) :] != sizes or not values.isfinite().all():
                raise ValueError(f"{key} has shape {tuple(values.shape)}, or values that are not finite")
        cameras = tuple(
            Camera(tensors[f"cameras.{n}.K"], tensors[f"cameras.{n}.T_camera_world"], width, height, name)
            for n, (name, width, height) in enumerate(record["cameras"])
        )
        motions = {
            name: Motion(tensors[f"motions.{n}.rotations"], tensors[f"motions.{n}.translations"], fps, label)
            for n, (name, label, fps) in enumerate(record["motions"])
        }
        splits = {split: tuple(names) for split, names in record["splits"].items()}
        unknown = {name for names in splits.values() for name in names} - motions.keys()
        if unknown or not cameras or not {"train", "test"} <= splits.keys():
            raise ValueError(
                f"no cameras, no splits, or motions that are named but not there: {sorted(unknown)}"
            )
        return Scene(record["name"], cameras, motions, splits)
