"""Ranks: processes that torchrun started, on one machine or many, and that train as one.

Torchrun says in the environment who is who, and holds a store of a few words that outlives every rank. There
the first rank that fails takes the word, so that of all ranks one says what went wrong.
"""

import functools
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

import torch
import torch.distributed as dist

from dsar.devices import choose_device
from dsar.errors import ConfigError, DsarError, TrainingError

_NAMES = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
_MAIN_MEMORY = torch.device("cpu")

T = TypeVar("T")


@dataclass(frozen=True)
class Launch:
    """This process among those that were started together."""

    rank: int
    """Its number among all."""
    world_size: int
    """How many there are."""
    local_rank: int
    """Its number on this machine."""
    local_world_size: int
    """How many there are on this machine."""


def launched() -> Launch | None:
    """Return what torchrun said of this process; None where it started none.

    Raises:
        ConfigError: something else said a part of it.
    """
    if not {"RANK", "WORLD_SIZE"} <= os.environ.keys():
        return None
    missing = [name for name in _NAMES if name not in os.environ]
    if missing:
        raise ConfigError(
            f"the environment has RANK and WORLD_SIZE, but no {', '.join(missing)}: start ranks with "
            "torchrun (docs/gpu.md), or unset them to train without"
        )
    try:
        return Launch(*(int(os.environ[name]) for name in _NAMES[:4]))
    except ValueError as error:
        found = ", ".join(f"{name}={os.environ[name]}" for name in _NAMES[:4])
        raise ConfigError(f"expected the numbers that torchrun sets, found {found}") from error


def is_first() -> bool:
    """Return whether this process writes files and shows progress: alone, or the first rank."""
    launch = launched()
    return launch is None or launch.rank == 0


def own_device(name: str) -> torch.device:
    """Return the device that a flag names; a rank takes the GPU of its number on its machine.

    Raises:
        ConfigError: there is no such device, or the flag gives one GPU to several ranks.
    """
    launch = launched()
    if launch is None or name == "cpu":
        return choose_device(name)
    if ":" in name and launch.local_world_size > 1:
        raise ConfigError(
            f"--device {name}: {launch.local_world_size} ranks of this machine cannot share one GPU; give "
            "--device cuda, and each takes its own (CUDA_VISIBLE_DEVICES says which there are)"
        )
    device = choose_device(name)
    if ":" in name or device.type == "cpu":
        return device
    count = torch.cuda.device_count()
    if launch.local_world_size > count:
        raise ConfigError(
            f"torchrun started {launch.local_world_size} ranks on this machine, which has {count} GPU(s): "
            f"give --nproc-per-node {count}, or --device cpu"
        )
    return torch.device("cuda", launch.local_rank)


@contextmanager
def joined(device: torch.device) -> Iterator[None]:
    """Join this process with the other ranks, if it is one; inside of another such block do nothing.

    Numbers in main memory are added by gloo, those of GPUs by NCCL where torch has it.
    """
    launch = launched()
    if launch is None or dist.is_initialized():
        yield
        return
    backend = "gloo"
    if device.type == "cuda":
        torch.cuda.set_device(device)
        backend = "cpu:gloo,cuda:nccl" if dist.is_nccl_available() else backend
    with _mortal():
        dist.init_process_group(backend, store=_store(), rank=launch.rank, world_size=launch.world_size)
    yield
    # A group that broke is left as it is: NCCL would wait for who is gone.
    dist.destroy_process_group()


def from_first(function: Callable[[], T]) -> T:
    """Return what a function returns in the first rank; where it raises, raise the same in all."""
    if not dist.is_initialized():
        return function()
    outcome: list = [None, None]
    if dist.get_rank() == 0:
        try:
            outcome[0] = function()
        except (DsarError, OSError) as error:
            outcome[1] = error
    with naming_lost_ranks():
        dist.broadcast_object_list(outcome, 0, device=_MAIN_MEMORY)
    if outcome[1] is not None:
        raise outcome[1]
    return outcome[0]


@contextmanager
def naming_lost_ranks() -> Iterator[None]:
    """Say in a user's words what a rank meets when another is gone.

    Raises:
        TrainingError: instead of what torch raises.
    """
    try:
        yield
    except RuntimeError as error:
        if isinstance(error, DsarError) or not is_broken_group(error):
            raise
        raise TrainingError(
            f"a rank of {dist.get_world_size()} ended before its time, and with it all others; torchrun says "
            "which one and how (signal 9: memory probably ran out)"
        ) from error


def is_broken_group(error: RuntimeError) -> bool:
    """Return whether torch raised an error because another process of the group is gone."""
    return isinstance(error, dist.DistError) or "gloo" in str(error)


def takes_the_word() -> bool:
    """Return whether this process is the one that says why all end: alone, or the first rank to fail."""
    try:
        return launched() is None or _store().add("dsar/word", 1) == 1
    except (ConfigError, RuntimeError):
        # Nobody can be asked any more.
        return True


@functools.cache
def _store() -> dist.Store:  # pyright: ignore[reportPrivateImportUsage]
    launch = launched()
    assert launch is not None
    ranks = launch.rank, launch.world_size
    store, _, _ = next(dist.rendezvous("env://", *ranks, timeout=timedelta(minutes=5)))  # pyright: ignore
    return dist.PrefixStore("dsar", store)  # pyright: ignore[reportPrivateImportUsage]


@contextmanager
def _mortal() -> Iterator[None]:
    """Let SIGTERM end the process at once: Python's handlers do not run while it waits for other ranks."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
