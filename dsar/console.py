"""What a person sees while a command works: a bar on a terminal, plain lines in a log."""

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Literal, TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

ProgressStyle = Literal["auto", "rich", "plain", "none"]

Item = TypeVar("Item")


class ProgressBar:
    """Progress of one job, in [0, 1], with a line of text."""

    def __init__(self, style: ProgressStyle, title: str) -> None:
        self.style = ("rich" if sys.stderr.isatty() else "plain") if style == "auto" else style
        self.title = title
        self._printed = -1
        self._rich = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=self.style != "rich",
        )
        self._task = self._rich.add_task(title, total=1.0, text="")

    def show(self, share: float, text: str = "") -> None:
        """Show that `share` of the work is done; plain style prints every 5 %."""
        self._rich.update(self._task, completed=share, text=text)
        mark = int(share * 20)
        if self.style == "plain" and mark > self._printed:
            self._printed = mark
            sys.stderr.write(f"{self.title} {5 * mark:3d}% {text}\n")
            sys.stderr.flush()

    @contextmanager
    def running(self) -> Iterator["ProgressBar"]:
        """Draw the bar while the block runs."""
        with self._rich:
            yield self


def track_progress(items: Iterable[Item], count: int, style: ProgressStyle, title: str) -> Iterator[Item]:
    """Yield the items and show how many of `count` have passed."""
    with ProgressBar(style, title).running() as bar:
        for done, item in enumerate(items, start=1):
            yield item
            bar.show(done / max(count, 1), f"{done}/{count}")
