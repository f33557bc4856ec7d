"""Workers of a Dask cluster."""

import importlib
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from dsar.errors import ConfigError, MissingDependencyError, RenderError
from dsar_render.farm.transport import use_one_thread

_logger = logging.getLogger(__name__)

_TIMEOUT_S = 10.0
"""Seconds within which a cluster's scheduler must answer."""


class ClusterWorkers(Executor):
    """Workers of a Dask cluster, which itself gives a dead worker's tasks to another."""

    remote = True

    def __init__(self, scheduler: str) -> None:
        distributed = require_distributed()
        with _connection_errors(scheduler):
            self._client = distributed.Client(scheduler, timeout=_TIMEOUT_S, set_as_default=False)
        try:
            with _connection_errors(scheduler):
                answers = self._client.run(use_one_thread, on_error="return")
                threads = self._client.nthreads().values()
            check_workers(scheduler, answers)
        except BaseException:
            self._client.close()
            raise
        self.count = max(1, sum(threads))
        # No retries: they are for errors of the work, which come out at once.
        self._executor = self._client.get_executor(pure=False)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Begin a call as soon as a worker is free."""
        import dask.config

        # A frame is what Dask calls a large graph. What it would rather have scattered dies with a worker.
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1TB"}):
            return self._executor.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Cancel what is not done and leave the cluster, whose workers finish what is in hand."""
        self._executor.shutdown(wait=False)
        self._client.close()


@contextmanager
def cluster_errors(scheduler: str) -> Iterator[None]:
    """Turn Dask's own errors over lost tasks into a RenderError that says what to do."""
    distributed = require_distributed()
    try:
        yield
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


def check_workers(scheduler: str, answers: dict[str, Any]) -> None:
    """Raise ConfigError if workers cannot import this package; say so if there are none.

    Args:
        scheduler: Address of the cluster, for the message.
        answers: By worker's address, the error of its imports, if any.
    """
    faults = [(worker, error) for worker, error in answers.items() if isinstance(error, Exception)]
    if faults:
        worker, error = faults[0]
        raise ConfigError(
            f"--scheduler {scheduler}: {len(faults)} of {len(answers)} workers cannot run dsar: install "
            f"dsar-avatar of this version on them ({worker}: {error})"
        )
    if not answers:
        _logger.warning("--scheduler %s: it has no workers yet; waiting for them", scheduler)


def require_distributed() -> ModuleType:
    """Return Dask's package for clusters.

    Raises:
        MissingDependencyError: It is not installed.
    """
    try:
        return importlib.import_module("distributed")
    except ImportError as error:
        raise MissingDependencyError("--scheduler", "distributed", "farm") from error


@contextmanager
def _connection_errors(scheduler: str) -> Iterator[None]:
    """Turn what is raised where nobody answers into a ConfigError."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"--scheduler {scheduler}: no Dask scheduler answers there: expected tcp://HOST:PORT as "
            f"`dask scheduler` prints it; start one, or use --jobs ({error})"
        ) from error
