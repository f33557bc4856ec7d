"""Work in a process of its own, whose results arrive one by one: what it breaks stays behind with it."""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection


class SectionError(Exception):
    """The work ended before it was done; the message says why."""


def stream_isolated(work: Callable[..., Iterable[dict]], arguments: tuple, seconds: float) -> Iterator[dict]:
    """Yield what `work(*arguments)` yields in another process, as soon as it is there.

    The process is forked, so it needs no second import. A GPU must not have been asked for anything in this
    one, for CUDA does not survive a fork. A kernel that spoils its process's CUDA spoils nothing else.

    Raises:
        SectionError: The work raised, its process died, or it took longer than `seconds`.
    """
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_all, args=(sender, work, arguments))
    process.start()
    sender.close()
    deadline = time.monotonic() + seconds
    try:
        while True:
            if not receiver.poll(max(0.0, deadline - time.monotonic())):
                raise SectionError(f"took longer than {seconds:.0f} s")
            try:
                row, error = receiver.recv()
            except EOFError:
                process.join()
                raise SectionError(f"its process ended with code {process.exitcode}") from None
            if error is not None:
                raise SectionError(error)
            if row is None:
                return
            yield row
    finally:
        # The whole group: a compiler that it started must not go on.
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid or 0, signal.SIGKILL)
        process.kill()
        process.join()


def _send_all(sender: Connection, work: Callable[..., Iterable[dict]], arguments: tuple) -> None:
    os.setsid()
    try:
        for row in work(*arguments):
            sender.send((row, None))
        sender.send((None, None))
    except Exception as error:  # whatever it is, the other sections go on and the file names it
        sender.send((None, f"{type(error).__name__}: {error}"))
