"""The checkpoint of a run: `TrainingState` in files, written as a whole and read back."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor

from dsar.atomic_files import naming_storage_errors
from dsar.text import decode_text
from dsar.training import workers
from dsar.training.checkpoint import (
    FORMAT_VERSION,
    CheckpointProgress,
    Run,
    describe_avatar,
    read_progress,
    read_tensors,
    reading,
    replace_folder,
    write_progress,
)
from dsar.training.migrations import (
    OLDEST_VERSION,
    ROLLOUT_NAMES,
    cursor_tensors,
    rename_tensors,
)
from dsar.training.redivision import merge_registration, take_rollouts
from dsar.training.state import TrainingState

_OWN = ("rollouts", "registration")
"""Parts of the state that each worker has for itself, one file each."""


def write_checkpoint(run: Run, state: TrainingState) -> None:
    """Write a complete checkpoint, and put it in place at once: the first worker does, with all that are.

    Raises:
        StorageError: the system does not take it; the checkpoint before it stays.
    """
    folder, rank = run.folder / "checkpoint.tmp", workers.rank()
    with naming_storage_errors(run.checkpoint), _removed_on_failure(folder):
        tensors = state.state_dict()
        if rank == 0:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            for part in ("avatar", *state.optimizers):
                more = describe_avatar(state.avatar) if part == "avatar" else {}
                (folder / f"{part}.safetensors").write_bytes(_content(_part(tensors, part) | more))
        for part in _OWN:
            own = _content(_part(tensors, part))
            if rank == 0:
                (folder / f"{part}-0.safetensors").write_bytes(own)
            for number, content in workers.collected(own):
                (folder / f"{part}-{number}.safetensors").write_bytes(content)
        if rank == 0:
            write_progress(folder, _progress(state, run))
            replace_folder(folder, run.checkpoint)
        workers.barrier()


def read_checkpoint(run: Run, state: TrainingState) -> None:
    """Restore a worker's state, whose avatar was made by `load_checkpoint` already.

    Where another number of workers wrote it, rollouts and frames to register are divided anew.

    Raises:
        CheckpointError: a file is damaged or foreign.
    """
    at, folder = read_progress(run), run.checkpoint
    for part in state.optimizers:
        path = folder / f"{part}.safetensors"
        with reading(path):
            _load_part(state, part, read_tensors(path))
    count, own = len(state.rollouts.cursors), workers.rank()
    files = {
        part: [folder / f"{part}-{number}.safetensors" for number in range(writers(run))] for part in _OWN
    }
    with reading(files["rollouts"][0]):
        parts = [partial(_read_rollouts, path, at.format_version) for path in files["rollouts"]]
        _load_part(state, "rollouts", take_rollouts(parts, range(own * count, (own + 1) * count)))
    with reading(files["registration"][0]):
        maps = [read_tensors(path) for path in files["registration"]]
        _load_part(state, "registration", merge_registration(maps))
    state.step, state.progress, state.skipped, state.seconds = at.step, at.progress, at.skipped, at.seconds


def writers(run: Run) -> int:
    """Return how many workers wrote a checkpoint."""
    return max(1, sum(1 for _ in run.checkpoint.glob("rollouts-*.safetensors")))


def _load_part(state: TrainingState, part: str, tensors: dict[str, Tensor]) -> None:
    state.load_state_dict({f"{part}.{name}": value for name, value in tensors.items()})


def _read_rollouts(path: Path, version: int) -> dict[str, Tensor]:
    tensors = rename_tensors(read_tensors(path), version, ROLLOUT_NAMES)
    return tensors | (_read_cursors(path.with_suffix(".json")) if version == OLDEST_VERSION else {})


def _progress(state: TrainingState, run: Run) -> CheckpointProgress:
    # What the run refers to by path is found again from its folder, when all of it is moved.
    where = FORMAT_VERSION, state.step, state.progress, str(run.folder.resolve())
    return CheckpointProgress(*where, state.seconds, state.skipped, state.cut[1])


def _read_cursors(path: Path) -> dict[str, Tensor]:
    with reading(path):
        return cursor_tensors(json.loads(decode_text(path.read_bytes())))


def _part(tensors: dict[str, Tensor], part: str) -> dict[str, Tensor]:
    prefix = f"{part}."
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _content(tensors: dict[str, Tensor]) -> bytes:
    """Return what a file of tensors holds."""
    # Some tensors are one (the newest offset is state and record); the file format wants each by itself.
    return save(
        {
            name: tensor.detach().to("cpu", copy=True, memory_format=torch.contiguous_format)
            for name, tensor in tensors.items()
        }
    )


@contextmanager
def _removed_on_failure(folder: Path) -> Iterator[None]:
    """Give back the room that half a checkpoint takes."""
    try:
        yield
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
