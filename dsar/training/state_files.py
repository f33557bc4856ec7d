"""The checkpoint of a run: `TrainingState` in files, written as a whole and read back."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from dsar.atomic_files import naming_storage_errors
from dsar.errors import CheckpointError
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
from dsar.training.state import TrainingState

_OWN = ("rollouts", "registration")
"""Parts of the state that each worker keeps for itself."""


def write_checkpoint(run: Run, state: TrainingState) -> None:
    """Write a complete checkpoint, every worker its own rollouts, and put it in place at once.

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
                _write_part(folder / f"{part}.safetensors", _part(tensors, part) | more)
        workers.barrier()
        for part in _OWN:
            _write_part(folder / f"{part}-{rank}.safetensors", _part(tensors, part))
        workers.barrier()
        if rank == 0:
            write_progress(folder, _progress(state, run))
            replace_folder(folder, run.checkpoint)
        workers.barrier()


def read_checkpoint(run: Run, state: TrainingState) -> None:
    """Restore a worker's state, whose avatar was made by `load_checkpoint` already.

    Raises:
        CheckpointError: a file is damaged or foreign, or the run was trained by another number of workers.
    """
    at, folder, rank = read_progress(run), run.checkpoint, workers.rank()
    if not (folder / f"rollouts-{rank}.safetensors").exists():
        raise CheckpointError(f"{folder} has no state of worker {rank}; resume with the run's own --workers")
    files = {part: folder / f"{part}.safetensors" for part in state.optimizers}
    files |= {part: folder / f"{part}-{rank}.safetensors" for part in _OWN}
    for part, path in files.items():
        with reading(path):
            tensors = read_tensors(path)
            if part == "rollouts":
                tensors = rename_tensors(tensors, at.format_version, ROLLOUT_NAMES)
                if at.format_version == OLDEST_VERSION:
                    tensors |= _read_cursors(path.with_suffix(".json"))
            state.load_state_dict({f"{part}.{name}": value for name, value in tensors.items()})
    state.step, state.progress, state.skipped, state.seconds = at.step, at.progress, at.skipped, at.seconds


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


def _write_part(path: Path, tensors: dict[str, Tensor]) -> None:
    # Some tensors are one (the newest offset is state and record); the file format wants each by itself.
    copies = {
        name: tensor.detach().to("cpu", copy=True, memory_format=torch.contiguous_format)
        for name, tensor in tensors.items()
    }
    save_file(copies, path)


@contextmanager
def _removed_on_failure(folder: Path) -> Iterator[None]:
    """Give back the room that half a checkpoint takes."""
    try:
        yield
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
