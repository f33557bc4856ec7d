"""Tasks in flight on workers, their results in order, and retries when workers die."""

import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol, TypeVar

from dsar.errors import RenderError
from dsar_render.farm.transport import pack, run_packed, unpack

Task = TypeVar("Task")
Result = TypeVar("Result")

_logger = logging.getLogger(__name__)

_TASKS_PER_WORKER = 2
"""One in hand and one at hand: a worker need not wait for the caller, and few frames are in memory."""

_MAX_DEATHS = 3
"""A task that has been in flight so often when a worker died is not tried again."""


class Workers(Protocol):
    """Threads, processes or machines that take tasks: an executor that knows its size."""

    count: int
    """How many tasks are worked on at a time."""
    remote: bool
    """Whether tasks and results travel to other processes, as bytes."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Begin a call as soon as a worker is free."""
        ...

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Begin no further call, and let go of the workers."""
        ...


def run_in_order(
    start: Callable[[], Workers], work: Callable[[Task], Result], tasks: Iterable[Task]
) -> Iterator[Result]:
    """Yield work(task) of every task in order; see `dsar_render.farm.run_tasks`.

    Args:
        start: Starts the workers, which live as long as the iterator; called again when they have died.
        work: What is done with a task.
        tasks: Drawn one by one, when workers are free.
    """
    queue = _TaskQueue(start)
    try:
        remote = queue.workers.remote
        call = partial(run_packed, pack(work)) if remote else work
        for task in tasks:
            queue.submit(partial(call, pack(task) if remote else task))
            del task  # or its frame would be held while the next one is made
            yield from _unpacked(queue.pop_finished(), remote)
            while queue.is_full():
                wait(queue.in_flight(), return_when=FIRST_COMPLETED)
                yield from _unpacked(queue.pop_finished(), remote)
        while queue.submissions:
            wait(queue.in_flight(), return_when=FIRST_COMPLETED)
            yield from _unpacked(queue.pop_finished(), remote)
    finally:
        queue.workers.shutdown(cancel_futures=True)


def _unpacked(results: Iterator[Any], remote: bool) -> Iterator[Any]:
    """Yield results, unpacked if they come from another process."""
    return map(unpack, results) if remote else results


@dataclass
class _Submission:
    """A task that workers have, or had."""

    job: Callable[[], Any] | None
    """None once it is done: the frame that it holds may be large."""
    future: Future[Any] = field(default_factory=Future)
    deaths: int = 0
    """How often a worker died while this was in flight."""


class _TaskQueue:
    """Workers and the tasks submitted to them, in order; new workers when they die."""

    def __init__(self, start: Callable[[], Workers]) -> None:
        self._start = start
        self.workers = start()
        self.submissions: deque[_Submission] = deque()

    def submit(self, job: Callable[[], Any]) -> None:
        self.submissions.append(_Submission(job))
        self._submit(self.submissions[-1])

    def in_flight(self) -> list[Future[Any]]:
        """Return the tasks that are not done."""
        return [submission.future for submission in self.submissions if not submission.future.done()]

    def is_full(self) -> bool:
        return len(self.in_flight()) >= _TASKS_PER_WORKER * self.workers.count

    def pop_finished(self) -> Iterator[Any]:
        """Yield results in order, up to the first task that is not done; raise the first error of any."""
        while self.submissions:
            self._handle_failures()
            first = self.submissions[0].future
            if not first.done():
                return
            if first.exception() is None:  # else it has failed since we looked
                self.submissions.popleft()
                yield first.result()

    def _submit(self, submission: _Submission) -> None:
        assert submission.job is not None
        try:
            submission.future = self.workers.submit(submission.job)
        except BrokenExecutor as error:  # the workers died idle
            submission.future = Future()
            submission.future.set_exception(error)

    def _handle_failures(self) -> None:
        """Restart workers that died; raise the first error of a task."""
        errors: list[BaseException] = []
        for submission in self.submissions:
            if submission.job is None or not submission.future.done():
                continue
            if error := submission.future.exception():
                errors.append(error)
            else:
                submission.job = None
        if any(isinstance(error, BrokenExecutor) for error in errors):
            self._restart_workers()
        elif errors:
            raise errors[0]

    def _restart_workers(self) -> None:
        """Start new workers in the place of those that died, and submit again what these had."""
        self.workers.shutdown()
        lost = [task for task in self.submissions if isinstance(task.future.exception(), BrokenExecutor)]
        for submission in lost:
            submission.deaths += 1
        _logger.warning("render: a worker process died; frames in flight, done again: %d", len(lost))
        if max(submission.deaths for submission in lost) >= _MAX_DEATHS:
            raise RenderError(
                f"render: worker processes died {_MAX_DEATHS} times over the same frames, probably because "
                "memory ran out: give fewer --jobs or a lower --res, or look above for what they said"
            )
        self.workers = self._start()
        for submission in lost:
            self._submit(submission)
