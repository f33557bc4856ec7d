"""Independent tasks, such as the images of a rollout, by this process, by several, or by a cluster.

The tasks are made in the caller's thread, because a rollout runs forward only. `scheduling` keeps their order
and repeats what a dead worker had; `local_workers` and `cluster_workers` do the work; `transport` carries
tasks and results between processes.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TypeVar

from dsar.errors import ConfigError
from dsar_render.farm.cluster_workers import ClusterWorkers, cluster_errors, require_distributed
from dsar_render.farm.local_workers import ProcessWorkers, ThreadWorker
from dsar_render.farm.scheduling import run_in_order

__all__ = ["run_tasks"]

Task = TypeVar("Task")
Result = TypeVar("Result")


def run_tasks(
    work: Callable[[Task], Result], tasks: Iterable[Task], *, jobs: int = 1, scheduler: str | None = None
) -> Iterator[Result]:
    """Yield work(task) of every task, in the tasks' order, whatever order they are done in.

    At most two tasks per worker are in flight; only when one is done is the next drawn. A result is kept
    until all before it have been yielded, so it should be small: what is large, `work` writes.

    An error of `work` is raised at once. Then, and when the iterator is closed or interrupted, no further
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
        return run_in_order(ThreadWorker if jobs == 1 else partial(ProcessWorkers, jobs), work, tasks)
    if jobs > 1:
        raise ConfigError(f"--jobs {jobs} and --scheduler {scheduler} exclude each other: give one of them")
    require_distributed()
    return _run_on_cluster(scheduler, work, tasks)


def _run_on_cluster(
    scheduler: str, work: Callable[[Task], Result], tasks: Iterable[Task]
) -> Iterator[Result]:
    with cluster_errors(scheduler):
        yield from run_in_order(partial(ClusterWorkers, scheduler), work, tasks)
