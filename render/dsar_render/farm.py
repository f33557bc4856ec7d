"""Independent tasks, such as the images of a rollout, by this process, by several, or by a cluster.

The tasks are made in the caller's thread, because a rollout runs forward only. To other processes a task and
its result travel as bytes: torch would pass tensors through shared memory, of which a farm's containers have
little, and which goes when the process that made it is killed. The bytes are NumPy's: torch packs every
tensor as an archive of its own, of which a frame and its cameras have dozens.
"""

import importlib
import io
import logging
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any, TypeVar

import numba
import torch

from dsar.errors import ConfigError, MissingDependencyError, RenderError

T = TypeVar("T")
R = TypeVar("R")

_logger = logging.getLogger(__name__)

_TASKS_PER_WORKER = 2
"""One in hand and one at hand: a worker need not wait for the caller, and few frames are in memory."""

_MAX_DEATHS = 3
"""A task that has been in flight so often when a worker died is not tried again."""

_ANSWER_S = 10.0
"""Seconds within which a cluster's scheduler must answer."""

_stopping: ContextVar[Any] = ContextVar("stopping")
"""In a worker process: a shared number that is not zero once no further task is to be begun."""


def run_tasks(
    work: Callable[[T], R], tasks: Iterable[T], *, jobs: int = 1, scheduler: str | None = None
) -> Iterator[R]:
    """Yield work(task) of every task, in the tasks' order, whatever order they are done in.

    At most two tasks per worker are in flight; only when one is done is the next drawn. A result is kept
    until its turn comes, so it should be small: what is large, `work` writes.

    What `work` raises comes out at once. Then, and when the iterator is closed or interrupted, no further
    task is begun and those in hand are finished first, so that no file is left half; a cluster is not waited
    for. When a worker dies, the tasks in flight are done again: `work` must be able to repeat one.

    Args:
        work: A function of a module; other processes import it. It must not rely on the caller's state.
        tasks: Drawn one by one in the calling thread; what can be pickled, unless jobs is 1.
        jobs: Processes, each with one numeric thread; 1 stays in this one, in a thread beside the caller's.
        scheduler: Address `tcp://HOST:PORT` of a Dask cluster whose workers can import `work`.

    Raises:
        ConfigError: The flags exclude each other, or the cluster does not answer or lacks this package.
        MissingDependencyError: A scheduler is given and distributed is not installed.
        RenderError: Workers died again and again over the same tasks.
    """
    if jobs < 1:
        raise ConfigError(f"--jobs {jobs}: expected the number of processes, at least 1")
    if scheduler is None:
        return _in_order(_Thread if jobs == 1 else partial(_Processes, jobs), work, tasks)
    if jobs > 1:
        raise ConfigError(f"--jobs {jobs} and --scheduler {scheduler} exclude each other: give one of them")
    _require_distributed()
    return _on_cluster(scheduler, work, tasks)


def _on_cluster(scheduler: str, work: Callable[[T], R], tasks: Iterable[T]) -> Iterator[R]:
    distributed = _require_distributed()
    try:
        yield from _in_order(partial(_Cluster, scheduler), work, tasks)
    except distributed.KilledWorker as error:
        raise RenderError(
            f"--scheduler {scheduler}: workers died again and again over the same frame, probably because "
            "memory ran out: give them more, or render at a lower --res"
        ) from error
    except CancelledError as error:
        raise RenderError(
            f"--scheduler {scheduler}: the cluster dropped a frame, probably because its scheduler went "
            "away: start it again and run the same command"
        ) from error


class _Thread(ThreadPoolExecutor):
    """One thread of this process: it draws and writes while the caller's makes the next frame."""

    workers = 1
    apart = False

    def __init__(self) -> None:
        super().__init__(1, "render", _enter_thread, (numba.get_num_threads(),))


def _enter_thread(drawing: int) -> None:
    """Give a thread its numbers of threads, which Numba and torch count per thread.

    It draws with as many as the caller, and adds images up with one: for arrays of their size torch's others
    spin longer than they work.
    """
    numba.set_num_threads(drawing)
    torch.set_num_threads(1)


class _Processes(ProcessPoolExecutor):
    """Processes of this machine that end when this one does, however it ends.

    They do not hear SIGINT and SIGTERM, which a terminal or a farm may send to the whole group: the parent
    lets them finish what is in hand. The executor ends those it has left with SIGTERM when one has died, so
    they are led by a pipe instead: when its other end closes, they are gone.
    """

    apart = True

    def __init__(self, workers: int) -> None:
        self.workers = workers
        context = get_context("spawn")
        self._held, self._leash = context.Pipe(duplex=False)
        self._stopping = context.RawValue("b", 0)
        self._open: set[Future[Any]] = set()
        super().__init__(workers, context, _enter_process, (self._held, self._stopping))
        for _ in range(workers):
            self.submit(int)  # each starts a process, whose imports last about as long as the first frame

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        with _inheritably_blocked({signal.SIGINT, signal.SIGTERM}):
            future = super().submit(fn, *args, **kwargs)
        self._open.add(future)
        future.add_done_callback(self._open.discard)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Finish the tasks in hand, begin no other, and end the processes."""
        # The executor cannot cancel what it has already sent to a worker's queue.
        self._stopping.value = 1
        _wait_for_all(self._open)
        self._leash.close()
        super().shutdown()
        self._held.close()


class _Cluster(Executor):
    """Workers of a Dask cluster, which itself gives a dead worker's tasks to another."""

    apart = True

    def __init__(self, scheduler: str) -> None:
        distributed = _require_distributed()
        with _saying_who_is_silent(scheduler):
            self._client = distributed.Client(scheduler, timeout=_ANSWER_S, set_as_default=False)
        try:
            with _saying_who_is_silent(scheduler):
                answers = self._client.run(_use_one_thread, on_error="return")
                threads = self._client.nthreads().values()
            _check_workers(scheduler, answers)
        except BaseException:
            self._client.close()
            raise
        self.workers = max(1, sum(threads))
        # No retries: they are for errors of the work, which come out at once.
        self._executor = self._client.get_executor(pure=False)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        import dask.config

        # A frame is what Dask calls a large graph. What it would rather have scattered dies with a worker.
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1TB"}):
            return self._executor.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Cancel what is not done and leave the cluster, whose workers finish what is in hand."""
        self._executor.shutdown(wait=False)
        self._client.close()


@contextmanager
def _saying_who_is_silent(scheduler: str) -> Iterator[None]:
    """Turn what is raised where nobody answers into a ConfigError."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"--scheduler {scheduler}: no Dask scheduler answers there: expected tcp://HOST:PORT as "
            f"`dask scheduler` prints it; start one, or use --jobs ({error})"
        ) from error


def _check_workers(scheduler: str, answers: dict[str, Any]) -> None:
    """Raise ConfigError if workers cannot import this package; say so if there are none."""
    faults = [(worker, error) for worker, error in answers.items() if isinstance(error, Exception)]
    if faults:
        worker, error = faults[0]
        raise ConfigError(
            f"--scheduler {scheduler}: {len(faults)} of {len(answers)} workers cannot run dsar: install "
            f"dsar-avatar of this version on them ({worker}: {error})"
        )
    if not answers:
        _logger.warning("--scheduler %s: it has no workers yet; waiting for them", scheduler)


_Pool = _Thread | _Processes | _Cluster


@dataclass
class _Given:
    """A task that was given out."""

    job: Callable[[], Any] | None
    """None once it is done: the frame that it holds may be large."""
    future: Future[Any] = field(default_factory=Future)
    deaths: int = 0
    """How often a worker died while this was in flight."""


class _Crew:
    """Workers and what they have been given, in the tasks' order; new workers when they die."""

    def __init__(self, hire: Callable[[], _Pool]) -> None:
        self._hire = hire
        self.pool = hire()
        self.given: deque[_Given] = deque()

    def give(self, job: Callable[[], Any]) -> None:
        self.given.append(_Given(job))
        self._submit(self.given[-1])

    def open(self) -> list[Future[Any]]:
        """Return the tasks in flight."""
        return [each.future for each in self.given if not each.future.done()]

    def is_full(self) -> bool:
        return len(self.open()) >= _TASKS_PER_WORKER * self.pool.workers

    def results(self) -> Iterator[Any]:
        """Yield the results whose turn has come; raise the first error of any task."""
        while self.given:
            self._raise_or_replace()
            head = self.given[0].future
            if not head.done():
                return
            if head.exception() is None:  # else it has failed since we looked
                self.given.popleft()
                yield head.result()

    def _submit(self, given: _Given) -> None:
        assert given.job is not None
        try:
            given.future = self.pool.submit(given.job)
        except BrokenExecutor as error:  # the workers died idle
            given.future = Future()
            given.future.set_exception(error)

    def _raise_or_replace(self) -> None:
        errors: list[BaseException] = []
        for each in self.given:
            if each.job is None or not each.future.done():
                continue
            if error := each.future.exception():
                errors.append(error)
            else:
                each.job = None
        if any(isinstance(error, BrokenExecutor) for error in errors):
            self._replace()
        elif errors:
            raise errors[0]

    def _replace(self) -> None:
        """Take new workers in the place of some that died, and give them what these had."""
        self.pool.shutdown()
        lost = [each for each in self.given if isinstance(each.future.exception(), BrokenExecutor)]
        for each in lost:
            each.deaths += 1
        _logger.warning("render: a worker process died; frames in flight, done again: %d", len(lost))
        if max(each.deaths for each in lost) >= _MAX_DEATHS:
            raise RenderError(
                f"render: worker processes died {_MAX_DEATHS} times over the same frames, probably because "
                "memory ran out: give fewer --jobs or a lower --res, or look above for what they said"
            )
        self.pool = self._hire()
        for each in lost:
            self._submit(each)


def _in_order(hire: Callable[[], _Pool], work: Callable[[T], R], tasks: Iterable[T]) -> Iterator[R]:
    """Yield the results of workers that are there as long as the iterator runs."""
    crew = _Crew(hire)
    try:
        apart = crew.pool.apart
        does = partial(_work_apart, _packed(work)) if apart else work
        for task in tasks:
            crew.give(partial(does, _packed(task) if apart else task))
            del task  # or its frame would be held while the next one is made
            yield from _opened(crew.results(), apart)
            while crew.is_full():
                wait(crew.open(), return_when=FIRST_COMPLETED)
                yield from _opened(crew.results(), apart)
        while crew.given:
            wait(crew.open(), return_when=FIRST_COMPLETED)
            yield from _opened(crew.results(), apart)
    finally:
        crew.pool.shutdown(cancel_futures=True)


def _opened(results: Iterator[Any], apart: bool) -> Iterator[Any]:
    """Yield results, unpacked if they come from another process."""
    return map(pickle.loads, results) if apart else results


def _work_apart(packed_work: bytes, packed_task: bytes) -> bytes:
    """Return the pickled result of work on a task, in a process of this or another machine."""
    stopping = _stopping.get(None)
    if stopping is not None and stopping.value:
        return b""  # nobody asks for it any more
    _use_one_thread()
    try:
        work, task = pickle.loads(packed_work), pickle.loads(packed_task)
        return _packed(work(task))
    except Exception as error:
        if _survives_pickling(error):
            raise
        raise RenderError(f"{type(error).__name__}: {error}") from error


class _Pickler(pickle.Pickler):
    """Packs a tensor in main memory as the array that it is."""

    def reducer_override(self, obj: Any) -> Any:
        if type(obj) is torch.Tensor and obj.device.type == "cpu" and not obj.requires_grad:
            return torch.from_numpy, (obj.numpy(),)
        return NotImplemented


def _packed(value: object) -> bytes:
    buffer = io.BytesIO()
    _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(value)
    return buffer.getvalue()


def _survives_pickling(error: Exception) -> bool:
    """Return whether an error can come out of a worker; one that cannot would look like a worker's death."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return False
    return True


def _use_one_thread() -> None:
    """Compute in the calling thread alone: there is a worker for every core."""
    torch.set_num_threads(1)
    numba.set_num_threads(1)


def _enter_process(leash: Connection, stopping: Any) -> None:
    """Set up a worker process before its first task."""
    os.environ["OPENIMAGEIO_THREADS"] = "1"  # read when it is imported, which is later
    _stopping.set(stopping)
    threading.Thread(target=_leave_with, args=(leash,), daemon=True).start()


def _leave_with(leash: Connection) -> None:
    """End this process when the other end of the leash closes: nothing is ever sent through it."""
    leash.poll(None)
    os._exit(1)


@contextmanager
def _inheritably_blocked(signals: set[signal.Signals]) -> Iterator[None]:
    """Block signals in this thread and for good in processes it starts, which so never lack protection."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _wait_for_all(futures: set[Future[Any]]) -> None:
    """Wait until every future is done, also while others of them leave the set."""
    wait(list(futures))


def _require_distributed() -> ModuleType:
    try:
        return importlib.import_module("distributed")
    except ImportError as error:
        raise MissingDependencyError("--scheduler", "distributed", "farm") from error
