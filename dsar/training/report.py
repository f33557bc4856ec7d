"""What a run says of itself while it trains: metrics.jsonl, a listener, and warnings."""

import dataclasses
import json
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dsar.atomic_files import naming_storage_errors
from dsar.metrics.images import decibels

_log = logging.getLogger(__name__)
REPORT_EVERY = 20
"""Updates between lines of metrics.jsonl."""
_LEAST_SHARE, _LARGEST_SHARE = 1e-4, 1.0
_NEW = 0.05
"""Weight of the newest update in smoothed values."""


@dataclass(frozen=True)
class UpdateMetrics:
    """What one update says of itself."""

    loss: float
    """Total loss per rendered view."""
    mse: float | None
    """Mean squared colour error per view, over the crop and a random background; None without images."""
    gradients: dict[str, float] | None = None
    """Norms of the regularisers' gradients by the first convolution as shares of L_render's; None where
    they were not compared."""


@dataclass(frozen=True)
class Report:
    """One line of progress."""

    step: int
    """Updates done."""
    steps: int
    """Updates planned."""
    progress: float
    """Share of the schedule done, in [0, 1]."""
    stage: str
    """Stage of training."""
    loss: float
    """Smoothed loss."""
    psnr: float
    """Smoothed PSNR of training crops, dB."""
    seconds: float
    """Seconds since the first update of this process."""
    seconds_left: float | None
    """Seconds until the end at the pace of this process; None before it has one."""
    gradients: dict[str, float] | None = None
    """Each regulariser's gradient as a share of the images', when they were last compared."""
    skipped: int = 0
    """Updates of the schedule that were passed over so far, because time was short."""
    unregistered: int = 0
    """Frames that were not registered, because time was short."""


Reporter = Callable[[Report], None]


class Monitor:
    """Smooths what updates report, and passes it on."""

    def __init__(self, metrics: Path, steps: int, reporter: Reporter | None, *, began: float = 0.0) -> None:
        """Write to `metrics` and tell `reporter`; `began` is the progress with which this process began."""
        self._metrics, self._steps, self._reporter, self._began = metrics, steps, reporter, began
        self._smoothed: UpdateMetrics | None = None
        self._warned: set[str] = set()

    def update(self, metrics: UpdateMetrics) -> None:
        """Take in one update; say once of each regulariser that it moves nothing, or more than images do."""
        self._smoothed = _smooth(self._smoothed, metrics)
        for name, share in (metrics.gradients or {}).items():
            if name not in self._warned and not (share == 0 or _LEAST_SHARE <= share <= _LARGEST_SHARE):
                self._warned.add(name)
                effect = "moves almost nothing" if share < 1 else "outweighs the images"
                _log.warning("Loss %s %s: its gradient is %.2g times theirs", name, effect, share)

    def write(
        self, step: int, progress: float, stage: str, seconds: float, cut: tuple[int, int] = (0, 0)
    ) -> None:
        """Append a line of smoothed values to metrics.jsonl and show it to the listener.

        `cut` are the updates that were passed over, and the frames that were not registered.
        """
        assert self._smoothed is not None
        line = self._line(step, progress, stage, seconds, self._smoothed, cut)
        with naming_storage_errors(self._metrics), self._metrics.open("ab+") as file:
            # What a killed run has left of a line stays one by itself.
            whole = file.tell() == 0 or (file.seek(-1, os.SEEK_END) >= 0 and file.read(1) == b"\n")
            file.write(
                ("" if whole else "\n").encode() + json.dumps(dataclasses.asdict(line)).encode() + b"\n"
            )
        if self._reporter is not None:
            self._reporter(line)

    def show(self, step: int, progress: float, stage: str, seconds: float, metrics: UpdateMetrics) -> None:
        """Show the listener work that counts as no update."""
        if self._reporter is not None:
            self._reporter(self._line(step, progress, stage, seconds, metrics, (0, 0)))

    def _line(
        self,
        step: int,
        progress: float,
        stage: str,
        seconds: float,
        metrics: UpdateMetrics,
        cut: tuple[int, int],
    ) -> Report:
        psnr = decibels(metrics.mse or 0.0)
        gained = progress - self._began
        left = seconds * (1 - progress) / gained if gained > 0 else None
        numbers = (step, self._steps, progress, stage, metrics.loss, psnr, seconds, left, metrics.gradients)
        return Report(*numbers, *cut)


def warn_if_cut_short(step: int, cut: tuple[int, int], minutes: float | None) -> None:
    """Log what a run that is done left out for the limit on its time."""
    skipped, unregistered = cut
    if skipped:
        _log.warning(
            "Cut short: %d of %d updates; the schedule was compressed to fit into %g minutes",
            *(step, step + skipped, minutes),
        )
    if unregistered:
        _log.warning("Cut short: %d frames were not registered, for lack of time", unregistered)


def _smooth(before: UpdateMetrics | None, newest: UpdateMetrics) -> UpdateMetrics:
    if before is None:
        return newest
    # An update without images keeps what the last images said.
    mse = newest.mse if before.mse is None else before.mse
    if newest.mse is not None and before.mse is not None:
        mse = (1 - _NEW) * before.mse + _NEW * newest.mse
    gradients = before.gradients if newest.gradients is None else newest.gradients
    return UpdateMetrics((1 - _NEW) * before.loss + _NEW * newest.loss, mse, gradients)
