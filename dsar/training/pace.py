"""When training ends before its last update: the time it takes, and signals to stop."""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager

from dsar.training import workers


class Clock:
    """The time since the first update, which compiles kernels where they never ran before."""

    def __init__(self) -> None:
        self.began: float | None = None

    def start(self) -> None:
        """Begin to count, unless it has begun."""
        self.began = self.began if self.began is not None else time.monotonic()

    def seconds(self) -> float:
        """Return the seconds counted."""
        return 0.0 if self.began is None else time.monotonic() - self.began


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM in the first worker; the others follow it and ignore the keyboard."""
    received: list[int] = []
    first = workers.rank() == 0

    def note(number: int, _frame: object) -> None:
        if first:
            received.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def leave(received: list[int]) -> None:
    """End training in the way that the signal asks for."""
    if signal.SIGTERM in received:
        raise SystemExit(128 + signal.SIGTERM)
    if received:
        raise KeyboardInterrupt
