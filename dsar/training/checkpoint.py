"""Run folders: what is written where, and how it is read back. No pickle is ever loaded.

config.json              every setting of the run
scene.safetensors        the capture's cameras and motions, without its images (`dsar.training.scene`)
checkpoint/              replaced as a whole, never half written
    avatar.safetensors       parameters, skeleton, atlas
    adam.safetensors, muon.safetensors   moments of the optimisers
    rollouts-<rank>.safetensors   where each worker's rollouts stand, and what they remember
    registration-<rank>.safetensors   offsets of the still and the registered frames
    guards.safetensors       where guards act, once they were measured (`dsar.training.guard_limits`)
    progress.json            step, progress, format version, the run's folder at that time
metrics.jsonl            one line per report
figures.json, stress.json   what `dsar eval` and `dsar stress` found
previews/, report.html   for people
"""

import dataclasses
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.charts import Atlas, decode_charts, encode_charts
from dsar.body.model import PARENTS
from dsar.config import EMBEDDED_CAPTURES, TrainConfig, config_from_json
from dsar.errors import CheckpointError, ConfigError
from dsar.text import decode_text
from dsar.training.migrations import OLDEST_VERSION, rename_tensors
from dsar.types import Body

FORMAT_VERSION = 4
_BODY = ("vertices", "faces", "joints", "weights", "uv", "uv_faces")
_SINCE_LAYERS = ("texel_beneath", "texel_borrowed")
# What a damaged or foreign file can raise on its way to what it should have been.
_DAMAGE = (SafetensorError, ValueError, KeyError, IndexError, TypeError, AttributeError, RuntimeError)
LOGGER = logging.getLogger(__name__)


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
    def scene(self) -> Path:
        """What drives the avatar by default: the capture's cameras and motions."""
        return self.folder / "scene.safetensors"

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
    def stress_pictures(self) -> Path:
        """Folder of the worst moment of each of its cases."""
        return self.previews / "stress"

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
    def guards(self) -> Path:
        """Where the guards of the checkpoint's rollouts act (`dsar.training.guard_limits`)."""
        return self.checkpoint / "guards.safetensors"

    @property
    def exists(self) -> bool:
        """Whether the run has a checkpoint."""
        return (self.checkpoint / "progress.json").exists()


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what is raised over a missing, damaged or foreign file of a run into one line that names it.

    Raises:
        CheckpointError: instead of it.
    """
    remedy = "copy the run again, or take it from a backup"
    try:
        yield
    except CheckpointError:
        raise
    except FileNotFoundError as error:
        raise CheckpointError(f"{path}: expected a file of the run, found no such file; {remedy}") from error
    except _DAMAGE as error:
        why = f"lacks {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise CheckpointError(
            f"{path}: expected a file as dsar writes it, found {path.stat().st_size} bytes that are damaged "
            f"or something else ({why or type(error).__name__}); {remedy}"
        ) from error


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file of a run."""
    with reading(path):
        content = json.loads(decode_text(path.read_bytes()))
        if not isinstance(content, dict):
            raise TypeError(f"expected an object, found {type(content).__name__}")
        return content


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Return the tensors in a file of a run."""
    with reading(path):
        return _tensors(path.read_bytes())


def _tensors(content: bytes) -> dict[str, Tensor]:
    """Return the tensors of a file that was read: mapped to memory, it could be cut meanwhile.

    Each is a copy: torch aligns those, and sums over what lies just anywhere differ in the last digit.
    """
    return {name: tensor.clone() for name, tensor in load_tensors(content).items()}


def newest_run(root: Path = Path("runs")) -> Run:
    """Return the run with the newest checkpoint under `runs/`."""
    runs = sorted(root.glob("*/checkpoint/progress.json"), key=lambda path: path.stat().st_mtime)
    if not runs:
        raise CheckpointError(
            f"no trained run under {root.absolute()}; name one, or train one: dsar train --preset demo"
        )
    return Run(runs[-1].parent.parent)


def read_config(run: Run) -> TrainConfig:
    """Return the settings of a run, capture and body where they lie now.

    A path that is no more is looked for where it lay as seen from the run's folder: both may have been moved
    together. One that is relative (older runs have such) is looked for in the current folder, then in the
    folders that hold the run.
    """
    try:
        config = config_from_json(run.config)
    except ConfigError as error:
        raise CheckpointError(str(error)) from error
    capture = config.capture
    if capture not in EMBEDDED_CAPTURES:
        capture = _located(run, capture, "capture")
    body = None if config.body is None else _located(run, config.body, "body file")
    return dataclasses.replace(config, capture=capture, body=body)


def _located(run: Run, recorded: str, what: str) -> str:
    """Return the absolute path at which something that a run refers to lies now; where it lay, if nowhere."""
    path, folder = Path(recorded), run.folder.resolve()
    candidates = [path.resolve()]
    if not path.is_absolute():
        candidates += [above / path for above in folder.parents]
    elif run.exists and (then := read_progress(run).folder):
        candidates.append((folder / os.path.relpath(path, then)).resolve())
    located = next((place for place in candidates if place.exists()), candidates[0])
    if located != candidates[0]:
        LOGGER.warning("Run %s: its %s is not at %s, but at %s", run.folder, what, candidates[0], located)
    return str(located)


def load_checkpoint(
    run: Run, device: torch.device | str = "cpu"
) -> tuple[Avatar, TrainConfig, dict[str, str]]:
    """Return the trained avatar of a run, its settings, and its provenance for exported files.

    The avatar is on the `device`, wherever it was trained. Moving or renaming the run changes none of them
    but the places of capture and body.

    Raises:
        CheckpointError: there is no checkpoint, or one of its files is damaged, foreign or not finite.
    """
    if not run.exists:
        avatar = run.checkpoint / "avatar.safetensors"
        lacking = run.checkpoint / "progress.json" if avatar.exists() else avatar
        raise CheckpointError(f"{_without_checkpoint(run)}; expected {lacking}")
    config, progress = read_config(run), read_progress(run)
    path = run.checkpoint / "avatar.safetensors"
    with reading(path):
        content = path.read_bytes()
        tensors = rename_tensors(_tensors(content), progress.format_version)
        avatar = _avatar(tensors, config, path).to(device)
    name = Path(progress.folder).name if progress.folder else run.folder.resolve().name
    digest = hashlib.sha256(content).hexdigest()[:16]
    return avatar, config, {"checkpoint": digest, "run": name, "step": str(progress.step)}


def _without_checkpoint(run: Run) -> str:
    """Return what is in the place of a run that holds no checkpoint."""
    if not run.folder.is_dir():
        return f"{run.folder}: {'a file, no run folder' if run.folder.exists() else 'no such folder'}"
    left = run.folder / "checkpoint.old"
    if left.is_dir():
        return f"{run.folder} holds no checkpoint, but {left.name} of a crash: rename it to checkpoint"
    return f"{run.folder} holds no checkpoint"


def _avatar(tensors: dict[str, Tensor], config: TrainConfig, path: Path) -> Avatar:
    """Return the avatar that a checkpoint's tensors make."""
    for name, values in tensors.items():
        bad = int((~values.isfinite()).sum()) if values.is_floating_point() else 0
        if bad:
            raise CheckpointError(
                f"{path}: {name} has {bad} values that are not finite: training diverged, or the file is "
                "damaged; train again, or take the run from a backup"
            )
    body = Body(parents=PARENTS, **{name: tensors[f"body_{name}"] for name in _BODY})
    height, width = (int(size) for size in tensors.pop("atlas_size"))
    fields = ("positions", "weights", "frames", "tangents", "hidden")
    charts = decode_charts(tensors.pop("charts", None), height, width)
    atlas = Atlas(charts, width, tensors["texels"], *(tensors[f"texel_{name}"] for name in fields))
    avatar = Avatar(body, atlas, config.model, float(tensors.pop("fps")))
    for name in _SINCE_LAYERS:
        # Older avatars keep no looks.
        tensors.setdefault(name, torch.zeros_like(tensors["texel_hidden"]))
    expected = {name: tuple(value.shape) for name, value in avatar.state_dict().items()}
    present = {name: tuple(value.shape) for name, value in tensors.items()}
    for name in sorted(expected.keys() | present.keys()):
        if expected.get(name) != present.get(name):
            raise CheckpointError(
                f"{path}: {name} has shape {present.get(name, 'none')}, by config.json "
                f"{expected.get(name, 'none')}; one of the two files is of another run: copy both from one"
            )
    avatar.load_state_dict(tensors)
    return avatar.eval()


def describe_avatar(avatar: Avatar) -> dict[str, Tensor]:
    """Return what `load_checkpoint` needs besides the avatar's parameters to rebuild it."""
    return {
        "atlas_size": torch.tensor(avatar.atlas_size),
        "charts": encode_charts(avatar.charts),
        "fps": torch.tensor(avatar.fps, dtype=torch.float64),
    }


@dataclasses.dataclass(frozen=True)
class CheckpointProgress:
    """Where a run stood when its checkpoint was written."""

    format_version: int
    """Of the checkpoint's files."""
    step: int
    """Updates done."""
    progress: float
    """Share of the schedule that is done, in [0, 1]."""
    folder: str | None = None
    """The run's folder at that time; older checkpoints do not say it."""
    seconds: float = 0.0
    """Time that updates and registration took; 0 in older checkpoints, as are the next two."""
    skipped: float = 0.0
    """Updates of the schedule that were passed over, because time was short."""
    unregistered: int = 0
    """Frames that were not registered, because time was short."""


def write_progress(folder: Path, content: CheckpointProgress) -> None:
    """Write where the run stands; written last, it marks a checkpoint as complete."""
    (folder / "progress.json").write_text(json.dumps(dataclasses.asdict(content)))


def read_progress(run: Run) -> CheckpointProgress:
    """Return where a run's checkpoint stands.

    Raises:
        CheckpointError: the file is missing or damaged, or the checkpoint is of a format that is not read.
    """
    path = run.checkpoint / "progress.json"
    content = read_json(path)
    version = content.get("format_version", FORMAT_VERSION)
    if version not in range(OLDEST_VERSION, FORMAT_VERSION + 1):
        raise CheckpointError(
            f"{run.checkpoint} has format {version}, this version reads {OLDEST_VERSION} to {FORMAT_VERSION}"
        )
    number = int | float
    kinds = {"format_version": int, "step": int, "progress": number}
    later = {"folder": str, "seconds": number, "skipped": number, "unregistered": int}
    with reading(path):
        kinds |= {key: kind for key, kind in later.items() if key in content}
        for key, kind in kinds.items():
            if not isinstance(content.get(key), kind):
                raise TypeError(f"{key} is {content.get(key)!r}")
        return CheckpointProgress(**{key: content[key] for key in kinds})


def check_files(run: Run) -> None:
    """Read every file of a checkpoint, before workers do that would wait for one that fails.

    Raises:
        CheckpointError: one is damaged.
    """
    for path in sorted(run.checkpoint.iterdir()):
        if path.suffix == ".safetensors":
            read_tensors(path)
        elif path.suffix == ".json":
            with reading(path):
                json.loads(decode_text(path.read_bytes()))


def replace_folder(new: Path, final: Path) -> None:
    """Put a complete new folder in the place of an old one; a crash leaves one of them whole."""
    old = final.with_name(final.name + ".old")
    shutil.rmtree(old, ignore_errors=True)
    if final.exists():
        os.replace(final, old)
    os.replace(new, final)
    shutil.rmtree(old, ignore_errors=True)
