"""Several processes that train as one: each renders its own rollouts, gradients are summed.

Ranks that torchrun started (`dsar.training.launch`) are used as they are; otherwise the first process starts
the others.
Small tensors make intra-operation threads useless here, so every worker computes on one thread.
"""

import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numba
import torch
import torch.distributed as dist
from torch import Tensor, nn

from dsar.errors import DsarError, TrainingError
from dsar.training.launch import is_broken_group, launched, naming_lost_ranks

EXTRA_NUMBERS = 2
"""Extra numbers that travel with the gradients: a request to stop, and the time that was taken."""
_BACKEND = "gloo"
_ERROR_TIMEOUT_S, _JOIN_TIMEOUT_S = 5.0, 30.0
"""How long a worker that broke the group may take to say why, and one that is done to end."""


class Gradients:
    """One flat buffer that holds all gradients of a list of parameters, summed over workers at once."""

    def __init__(self, parameters: list[nn.Parameter]) -> None:
        self.buffer = parameters[0].new_zeros(sum(p.numel() for p in parameters) + EXTRA_NUMBERS)
        offset = 0
        for parameter in parameters:
            view = self.buffer[offset : offset + parameter.numel()]
            parameter.grad = view.view_as(parameter)
            offset += parameter.numel()

    def clear(self) -> None:
        """Set every gradient to zero, keeping the parameters' views into the buffer."""
        self.buffer.zero_()

    def average(self, stop: bool, seconds: float) -> tuple[bool, float]:
        """Replace gradients by their mean over workers; return whether any asked to stop, and the time.

        Only the first worker's clock counts, so that all see the same number.
        """
        if not dist.is_initialized():
            return stop, seconds
        extra = self.buffer[-EXTRA_NUMBERS:]
        if _adds_on_gpu(self.buffer):
            # Through main memory: a rank that is gone is noticed here, where NCCL would wait for it.
            extra = torch.zeros(EXTRA_NUMBERS)
        extra[0] = float(stop)
        extra[1] = seconds if rank() == 0 else 0.0
        if _adds_on_gpu(self.buffer):
            all_reduce([extra])
        all_reduce([self.buffer])
        stopped, shared = extra.tolist()
        self.buffer /= world_size()
        return stopped > 0, shared


def rank() -> int:
    """Return this worker's number."""
    return dist.get_rank() if dist.is_initialized() else 0


def world_size() -> int:
    """Return the number of workers."""
    return dist.get_world_size() if dist.is_initialized() else 1


def total_count(requested: int) -> int:
    """Return how many workers a run will have: the ranks that torchrun started, else as many as requested."""
    launch = launched()
    return requested if launch is None else launch.world_size


def local_count(count: int) -> int:
    """Return how many of so many workers are on this machine."""
    launch = launched()
    return count if launch is None else launch.local_world_size


def barrier() -> None:
    """Wait for all workers."""
    all_reduce([torch.zeros(1)])


def collected(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield in the first worker the number of each other one and what it gives; in those, nothing."""
    if world_size() == 1:
        return
    sizes = torch.zeros(world_size(), dtype=torch.int64)
    sizes[rank()] = len(content)
    all_reduce([sizes])
    if rank() > 0:
        dist.send(torch.frombuffer(bytearray(content), dtype=torch.uint8), 0)
        return
    for number, size in enumerate(sizes.tolist()[1:], 1):
        received = torch.empty(size, dtype=torch.uint8)
        dist.recv(received, number)
        yield number, received.numpy().tobytes()


def mean(value: float) -> float:
    """Return the mean of all workers' values, the same for all."""
    return begin_mean(value)()


def begin_mean(value: float) -> Callable[[], float]:
    """Begin to exchange values; return what waits for them and gives their mean, the same for all workers."""
    shared = torch.tensor(value, dtype=torch.float64)
    exchange = dist.all_reduce(shared, async_op=True) if dist.is_initialized() else None

    def wait() -> float:
        if exchange is not None:
            exchange.wait()
        return float(shared) / world_size()

    return wait


def all_reduce(tensors: Iterable[Tensor]) -> None:
    """Replace each tensor, wherever it is, by its sum over workers."""
    if dist.is_initialized():
        for tensor in tensors:
            # Gloo adds in main memory.
            shared = tensor if _adds_on_gpu(tensor) else tensor.cpu()
            dist.all_reduce(shared)
            if shared is not tensor:
                tensor.copy_(shared)


def _adds_on_gpu(tensor: Tensor) -> bool:
    return tensor.is_cuda and "nccl" in dist.get_backend_config()


def run_workers(count: int, work: Callable[..., None], arguments: tuple[Any, ...], report: Any) -> None:
    """Call `work(*arguments, report)` in `count` processes joined in a group, this one being the first.

    Only the first worker gets `report`; the others get None in its place. Ranks that are joined already all
    call this, and start no process.

    Raises:
        DsarError: what any of them raised; without words of its own a worker that died is a TrainingError.
    """
    if dist.is_initialized():
        with naming_lost_ranks(), _one_thread():
            work(*arguments, report if rank() == 0 else None)
        return
    if count == 1:
        with _one_thread():
            work(*arguments, report)
        return
    with tempfile.TemporaryDirectory() as folder:
        rendezvous = (Path(folder) / "rendezvous").as_uri()
        context = torch.multiprocessing.get_context("spawn")
        errors = context.SimpleQueue()
        group = (rendezvous, count, work)
        processes = [
            context.Process(target=_work_beside, args=(errors, i, *group, (*arguments, None)), daemon=True)
            for i in range(1, count)
        ]
        for process in processes:
            process.start()
        timeout_s = _JOIN_TIMEOUT_S
        try:
            _work(0, *group, (*arguments, report))
        except DsarError:
            timeout_s = 0.0  # they would wait for this one
            raise
        except RuntimeError as error:
            # The group breaks when one of it goes; that one knows why.
            _raise_cause(errors, processes, error)
        finally:
            for process in processes:
                process.join(timeout=timeout_s)
                process.kill()


def _raise_cause(errors: Any, processes: Sequence[Any], error: RuntimeError) -> NoReturn:
    """Raise what another worker said, or how one ended; else what happened here."""
    deadline = time.monotonic() + _ERROR_TIMEOUT_S
    while time.monotonic() < deadline and all(process.is_alive() for process in processes):
        time.sleep(0.05)
    if not errors.empty():
        raise errors.get() from error
    codes = {number: process.exitcode for number, process in enumerate(processes, 1) if process.exitcode}
    for number, code in codes.items():
        how = f"signal {-code}" if code < 0 else f"code {code}"
        memory = ", probably because memory ran out: give fewer --workers" if code == -signal.SIGKILL else ""
        raise TrainingError(f"worker {number} of {len(processes) + 1} ended with {how}{memory}") from error
    raise error


def _work_beside(errors: Any, *arguments: Any) -> None:
    """Work in a process beside the first; what a user should know is told to it, and said by it alone."""
    try:
        _work(*arguments)
    except (DsarError, OSError) as error:
        errors.put(error)
        sys.exit(1)
    except RuntimeError as error:
        if not is_broken_group(error):
            raise
        sys.exit(1)  # the group broke: whoever broke it says why


def _work(
    number: int, rendezvous: str, count: int, work: Callable[..., None], arguments: tuple[Any, ...]
) -> None:
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    with _group(rendezvous, number, count):
        work(*arguments)


@contextmanager
def _group(method: str, number: int, count: int) -> Iterator[None]:
    dist.init_process_group(_BACKEND, init_method=method, rank=number, world_size=count)
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
