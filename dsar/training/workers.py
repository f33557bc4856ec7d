"""Several processes that train as one: each renders its own rollouts, gradients are summed.

Started by torchrun, the processes it made are used; otherwise the first process starts the others.
Small tensors make intra-operation threads useless here, so every worker computes on one thread.
"""

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
import torch
import torch.distributed as dist
from torch import Tensor, nn

TIMELY = 2
"""Extra numbers that travel with the gradients: a request to stop, and the share of the budget used."""


class Gradients:
    """One flat buffer that holds all gradients of a list of parameters, summed over workers at once."""

    def __init__(self, parameters: list[nn.Parameter]) -> None:
        self.buffer = torch.zeros(sum(p.numel() for p in parameters) + TIMELY)
        offset = 0
        for parameter in parameters:
            view = self.buffer[offset : offset + parameter.numel()]
            parameter.grad = view.view_as(parameter)
            offset += parameter.numel()

    def clear(self) -> None:
        """Set every gradient to zero, keeping the parameters' views into the buffer."""
        self.buffer.zero_()

    def average(self, stop: bool, used: float) -> tuple[bool, float]:
        """Replace gradients by their mean over workers; return whether any asked to stop, and the time used.

        Only the first worker's clock counts, so that all see the same number.
        """
        self.buffer[-2] = float(stop)
        self.buffer[-1] = used if rank() == 0 else 0.0
        if dist.is_initialized():
            dist.all_reduce(self.buffer)
        stopped, share = bool(self.buffer[-2] > 0), float(self.buffer[-1])
        if dist.is_initialized():
            self.buffer /= count()
        return stopped, share


def rank() -> int:
    """Return this worker's number."""
    return dist.get_rank() if dist.is_initialized() else 0


def count() -> int:
    """Return the number of workers."""
    return dist.get_world_size() if dist.is_initialized() else 1


def here(wanted: int) -> int:
    """Return how many workers this machine will have: those that torchrun made, else as many as wanted."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", wanted))


def barrier() -> None:
    """Wait for all workers."""
    if dist.is_initialized():
        dist.barrier()


def add_up(tensors: Iterable[Tensor]) -> None:
    """Replace each tensor by its sum over workers."""
    if dist.is_initialized():
        for tensor in tensors:
            dist.all_reduce(tensor)


def run_workers(count: int, work: Callable[..., None], arguments: tuple[Any, ...], report: Any) -> None:
    """Call `work(*arguments, report)` in `count` processes joined in a group, this one being the first.

    Only the first worker gets `report`; the others get None in its place.
    """
    if "RANK" in os.environ:
        with _group("env://", int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])):
            work(*arguments, report if rank() == 0 else None)
        return
    if count == 1:
        with _one_thread():
            work(*arguments, report)
        return
    with tempfile.TemporaryDirectory() as folder:
        rendezvous = (Path(folder) / "rendezvous").as_uri()
        context = torch.multiprocessing.get_context("spawn")
        others = [
            context.Process(target=_work, args=(rendezvous, i, count, work, (*arguments, None)), daemon=True)
            for i in range(1, count)
        ]
        for process in others:
            process.start()
        try:
            _work(rendezvous, 0, count, work, (*arguments, report))
        finally:
            for process in others:
                process.join(timeout=30)
                process.kill()


def _work(
    rendezvous: str, number: int, count: int, work: Callable[..., None], arguments: tuple[Any, ...]
) -> None:
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    with _group(rendezvous, number, count):
        work(*arguments)


@contextmanager
def _group(method: str, number: int, count: int) -> Iterator[None]:
    dist.init_process_group("gloo", init_method=method, rank=number, world_size=count)
    try:
        with _one_thread():
            yield
    finally:
        dist.destroy_process_group()


@contextmanager
def _one_thread() -> Iterator[None]:
    torch_threads, numba_threads = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(torch_threads)
        numba.set_num_threads(numba_threads)
