"""Run folders: what is written where, and how it is read back. No pickle is ever loaded.

config.json              every setting of the run
checkpoint/              replaced as a whole, never half written
    avatar.safetensors       parameters, skeleton, atlas
    adam.safetensors, muon.safetensors   moments of the optimisers
    rollouts-<rank>.safetensors, rollouts-<rank>.json   carried state of each worker's rollouts
    registration-<rank>.safetensors   offsets of the still and the registered frames
    progress.json            step, progress, format version
metrics.jsonl            one line per report
figures.json, stress.json   what `dsar eval` and `dsar stress` found
previews/, report.html   for people
"""

import dataclasses
import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.body.atlas import Atlas
from dsar.body.model import PARENTS
from dsar.config import TrainConfig, config_from_json
from dsar.errors import CheckpointError, ConfigError
from dsar.types import Body

FORMAT_VERSION = 3
_BODY = ("vertices", "faces", "joints", "weights", "uv", "uv_faces")


@dataclasses.dataclass(frozen=True)
class Run:
    """The paths of a run folder."""

    folder: Path
    """The run's own folder."""

    @property
    def config(self) -> Path:
        """All settings."""
        return self.folder / "config.json"

    @property
    def metrics(self) -> Path:
        """Training curve, one JSON object a line."""
        return self.folder / "metrics.jsonl"

    @property
    def figures(self) -> Path:
        """What `dsar eval` found."""
        return self.folder / "figures.json"

    @property
    def stress(self) -> Path:
        """What `dsar stress` found."""
        return self.folder / "stress.json"

    @property
    def study(self) -> Path:
        """The tables of the models beside it, where `dsar eval` made some (`runs/study/study.json`)."""
        own, near = self.folder.parent / "study.json", self.folder.parent / "study" / "study.json"
        return own if own.exists() else near

    @property
    def report(self) -> Path:
        """The page that shows all of it."""
        return self.folder / "report.html"

    @property
    def previews(self) -> Path:
        """Folder of sheets and videos."""
        return self.folder / "previews"

    @property
    def checkpoint(self) -> Path:
        """The newest complete checkpoint."""
        return self.folder / "checkpoint"

    @property
    def exists(self) -> bool:
        """Whether the run has a checkpoint."""
        return (self.checkpoint / "progress.json").exists()


def newest_run(root: Path = Path("runs")) -> Run:
    """Return the run with the newest checkpoint under `runs/`."""
    found = sorted(root.glob("*/checkpoint/progress.json"), key=lambda path: path.stat().st_mtime)
    if not found:
        raise CheckpointError(
            f"no trained run under {root}/; name one, or train one: dsar train --preset demo"
        )
    return Run(found[-1].parent.parent)


def load_checkpoint(run: Run) -> tuple[Avatar, TrainConfig, dict[str, str]]:
    """Return the trained avatar of a run, its settings, and its provenance for exported files."""
    if not run.exists:
        raise CheckpointError(
            f"{run.folder} holds no checkpoint; expected {run.checkpoint}/avatar.safetensors"
        )
    try:
        config = config_from_json(run.config)
    except ConfigError as error:
        raise CheckpointError(str(error)) from error
    progress = read_progress(run)
    path = run.checkpoint / "avatar.safetensors"
    tensors = load_file(path)
    body = Body(parents=PARENTS, **{name: tensors[f"body_{name}"] for name in _BODY})
    height, width = (int(size) for size in tensors.pop("atlas_size"))
    fields = ("positions", "weights", "frames", "tangents", "hidden")
    atlas = Atlas(height, width, tensors["texels"], *(tensors[f"texel_{name}"] for name in fields))
    avatar = Avatar(body, atlas, config.model, float(tensors.pop("fps")))
    avatar.load_state_dict(tensors)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    provenance = {"checkpoint": digest, "run": run.folder.name, "step": str(progress["step"])}
    return avatar.eval(), config, provenance


def save_avatar(avatar: Avatar, folder: Path) -> None:
    """Write the avatar's parameters and everything needed to rebuild it."""
    tensors = {name: value.detach().contiguous() for name, value in avatar.state_dict().items()}
    tensors["atlas_size"] = torch.tensor(avatar.atlas_size)
    tensors["fps"] = torch.tensor(avatar.fps, dtype=torch.float64)
    save_file(tensors, folder / "avatar.safetensors")


def save_optimizers(optimizers: Mapping[str, torch.optim.Optimizer], folder: Path) -> None:
    """Write the optimisers' moments; the parameters' order is the key."""
    for label, optimizer in optimizers.items():
        state = optimizer.state_dict()["state"]
        tensors = {f"{index}.{name}": value for index, slot in state.items() for name, value in slot.items()}
        save_file(tensors, folder / f"{label}.safetensors")


def load_optimizers(optimizers: Mapping[str, torch.optim.Optimizer], folder: Path) -> None:
    """Restore what `save_optimizers` wrote."""
    for label, optimizer in optimizers.items():
        state: dict[int, dict[str, Tensor]] = {}
        for key, value in load_file(folder / f"{label}.safetensors").items():
            index, name = key.split(".", 1)
            state.setdefault(int(index), {})[name] = value
        optimizer.load_state_dict({**optimizer.state_dict(), "state": state})


def save_rollouts(folder: Path, rank: int, tensors: Mapping[str, Tensor], places: Any) -> None:
    """Write one worker's carried state."""
    # Some tensors are one (the newest offset is state and record); the file format wants each by itself.
    copies = {
        name: tensor.detach().clone(memory_format=torch.contiguous_format) for name, tensor in tensors.items()
    }
    save_file(copies, folder / f"rollouts-{rank}.safetensors")
    (folder / f"rollouts-{rank}.json").write_text(json.dumps(places))


def load_rollouts(folder: Path, rank: int) -> tuple[dict[str, Tensor], Any]:
    """Restore what `save_rollouts` wrote.

    Raises:
        CheckpointError: the run was trained by another number of workers.
    """
    path = folder / f"rollouts-{rank}.safetensors"
    if not path.exists():
        raise CheckpointError(f"{folder} has no state of worker {rank}; resume with the run's own --workers")
    return load_file(path), json.loads((folder / f"rollouts-{rank}.json").read_text())


def save_registration(folder: Path, rank: int, tensors: Mapping[str, Tensor]) -> None:
    """Write one worker's registered maps."""
    save_file(dict(tensors), folder / f"registration-{rank}.safetensors")


def load_registration(folder: Path, rank: int) -> dict[str, Tensor]:
    """Restore what `save_registration` wrote."""
    return load_file(folder / f"registration-{rank}.safetensors")


def save_progress(folder: Path, step: int, progress: float) -> None:
    """Write where the run stands; written last, it marks a checkpoint as complete."""
    content = {"format_version": FORMAT_VERSION, "step": step, "progress": progress}
    (folder / "progress.json").write_text(json.dumps(content))


def read_progress(run: Run) -> dict[str, Any]:
    """Return step and progress of a run's checkpoint."""
    content = json.loads((run.checkpoint / "progress.json").read_text())
    if content["format_version"] != FORMAT_VERSION:
        raise CheckpointError(
            f"{run.checkpoint} has format {content['format_version']}, this version reads {FORMAT_VERSION}"
        )
    return content


def replace_folder(new: Path, final: Path) -> None:
    """Put a complete new folder in the place of an old one; a crash leaves one of them whole."""
    old = final.with_name(final.name + ".old")
    shutil.rmtree(old, ignore_errors=True)
    if final.exists():
        os.replace(final, old)
    os.replace(new, final)
    shutil.rmtree(old, ignore_errors=True)


def load(folder: str | Path) -> Avatar:
    """Return the trained avatar of a run folder."""
    return load_checkpoint(Run(Path(folder)))[0]
