"""Workers of this machine: a thread beside the caller's, or processes that never outlive it."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import numba
import torch

from dsar_render.farm.transport import stop_flag


class ThreadWorker(ThreadPoolExecutor):
    """One thread of this process: it draws and writes while the caller's makes the next frame."""

    count = 1
    remote = False

    def __init__(self) -> None:
        super().__init__(1, "render", _init_thread, (numba.get_num_threads(),))


def _init_thread(drawing: int) -> None:
    """Give a thread its numbers of threads, which Numba and torch count per thread.

    It draws with as many as the caller, and adds images up with one: for arrays of their size torch's others
    spin longer than they work.
    """
    numba.set_num_threads(drawing)
    torch.set_num_threads(1)


class ProcessWorkers(ProcessPoolExecutor):
    """Processes of this machine that end when this one does, however it ends.

    They do not hear SIGINT and SIGTERM, which a terminal or a farm may send to the whole group: the parent
    lets them finish what is in hand. The executor ends those it has left with SIGTERM when one has died, so
    they hold a lease instead, one end of a pipe: when this process closes the other, they end.
    """

    remote = True

    def __init__(self, count: int) -> None:
        self.count = count
        context = get_context("spawn")
        self._leased, self._lease = context.Pipe(duplex=False)
        self._stop = context.RawValue("b", 0)
        self._in_flight: set[Future[Any]] = set()
        super().__init__(count, context, _init_process, (self._leased, self._stop))
        for _ in range(count):
            self.submit(int)  # each starts a process, whose imports last about as long as the first frame

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Begin a call as soon as a process is free; start processes that are missing."""
        with _signals_blocked({signal.SIGINT, signal.SIGTERM}):
            future = super().submit(fn, *args, **kwargs)
        self._in_flight.add(future)
        future.add_done_callback(self._in_flight.discard)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Finish the tasks in hand, begin no other, and end the processes."""
        # The executor cannot cancel what it has already sent to a worker's queue.
        self._stop.value = 1
        wait_for(list(self._in_flight))  # a copy: those that end leave the set
        self._lease.close()
        super().shutdown()
        self._leased.close()


def _init_process(leased: Connection, stop: Any) -> None:
    """Set up a worker process before its first task."""
    os.environ["OPENIMAGEIO_THREADS"] = "1"  # read when it is imported, which is later
    stop_flag.set(stop)
    threading.Thread(target=_exit_with_lease, args=(leased,), daemon=True).start()


def _exit_with_lease(leased: Connection) -> None:
    """End this process when the lease's other end closes: nothing is ever sent through it."""
    leased.poll(None)
    os._exit(1)


@contextmanager
def _signals_blocked(signals: set[signal.Signals]) -> Iterator[None]:
    """Block signals in this thread and for good in processes it starts, which so never lack protection."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
