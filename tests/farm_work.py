"""Work for tests of the farm, importable by worker processes, and a command that a farm may kill."""

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch


@dataclass(frozen=True)
class Task:
    """One number, a tensor as a frame would carry, and a folder in which the work leaves traces."""

    number: int
    tensor: torch.Tensor
    folder: Path
    seconds: float = 0.0
    awaits: int | None = None
    """A task that must have ended before this does."""


class Unpicklable(Exception):
    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")


def tasks(folder, count, *, size=3, awaits=None):
    """Yield tasks, some of which end only after another has."""
    for number in range(count):
        yield Task(number, torch.full((size,), float(number)), folder, awaits=(awaits or {}).get(number))


def measure_or_die(task):
    """Return the number, its tensor's sum and the threads in use; be killed over task 3, the first time."""
    import numba

    mark = task.folder / "killed"
    if task.number == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if task.awaits is not None:
        while task.awaits not in ended(task.folder):
            time.sleep(0.01)
        time.sleep(0.1)  # file times are coarse, and the two must differ
    (task.folder / f"{task.number}.ended").touch()
    return task.number, float(task.tensor.sum()), torch.get_num_threads(), numba.get_num_threads()


def ended(folder):
    """Return the tasks that have been measured, in the order in which that was done."""
    traces = [(trace.stat().st_mtime_ns, int(trace.stem)) for trace in folder.glob("*.ended")]
    return [number for _, number in sorted(traces)]


def sum_up(task):
    return float(task.tensor.sum())


def die(task):
    with (task.folder / "deaths").open("a") as file:
        file.write("x")
    os.kill(os.getpid(), signal.SIGKILL)


def write_slowly(task):
    """Make a draft that takes a second; fail over the second task while that of the first is there."""
    draft = task.folder / f"{task.number}.draft"
    if task.number == 1:
        while not (task.folder / "0.draft").exists():
            time.sleep(0.01)
        raise Unpicklable("this", "that")
    draft.touch()
    time.sleep(1)
    draft.rename(task.folder / f"{task.number}.done")


def note_and_wait(task):
    """Write the process's number, then work on for the task's seconds."""
    (task.folder / f"{os.getpid()}.pid").touch()
    time.sleep(task.seconds)
    (task.folder / f"{task.number}.done").touch()


def main():
    """Run endless work, as `dsar render` would: SIGTERM ends it with 143."""
    from dsar_render.farm import run_tasks

    def leave(number, _):
        raise SystemExit(128 + number)

    signal.signal(signal.SIGTERM, leave)
    folder, seconds = Path(sys.argv[1]), float(sys.argv[2])
    endless = (Task(number, torch.zeros(1), folder, seconds) for number in range(1000))
    for _ in run_tasks(note_and_wait, endless, jobs=2):
        pass


if __name__ == "__main__":
    main()
