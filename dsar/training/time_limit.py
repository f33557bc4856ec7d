"""A limit on the time of training: the schedule stands, and is compressed only where it would not fit.

A run on a machine that is fast enough does the same updates as on any other, with a limit or without. Where
the updates that are left would take longer than the time that is left, each one passes over a part of the
schedule, so that rates still fall to their end. All workers decide alike: they share the first one's clock.
"""

from collections import defaultdict
from collections.abc import Iterator
from typing import Literal

from dsar.config import ScheduleConfig
from dsar.training.schedule import schedule_at

Part = Literal["template", "registration", "pretraining", "reduced", "whole"]
"""What training does; images are reduced or whole."""

REGISTRATION_SHARE = 0.4
"""Largest share of the limit that registration takes where time is short."""
_RELATIVE_COSTS: dict[Part, float] = {
    "template": 0.35, "registration": 0.5, "pretraining": 0.3, "reduced": 1.0, "whole": 1.2,
}  # fmt: skip
"""Of an update, or of a registered frame, as the demo's are: what is assumed of a part not yet measured."""
_OPTIMISM = 0.8
"""Factor on what is only assumed: an update that was passed over does not come back."""
_ENOUGH = 5
"""Updates after which the cost of a part counts as measured."""


class TimeLimit:
    """Follows the time that each part of training takes, and says what must be passed over."""

    def __init__(self, schedule: ScheduleConfig, used: float = 0.0, network_seconds: float = 0.0) -> None:
        """Begin to measure.

        Args:
            schedule: Its `minutes` are the limit.
            used: Seconds that earlier processes of the run took.
            network_seconds: What the network's arithmetic in an update takes at least.
        """
        self._schedule, self._network_seconds = schedule, network_seconds
        self._limit = None if schedule.minutes is None else 60 * schedule.minutes
        self.seconds = used
        """Taken by the whole run so far."""
        self._began = used
        self._taken: defaultdict[Part, float] = defaultdict(float)
        self._count: defaultdict[Part, int] = defaultdict(int)

    def note(self, part: Part, clock: float) -> None:
        """Note that an update, or a registered frame, ended at a time of this process's clock, seconds."""
        now = self._began + clock
        # The clock stands until the first update is over, which therefore cannot be measured.
        if now > self.seconds:
            self._taken[part] += now - self.seconds
            self._count[part] += 1
        self.seconds = now

    def passes_over(self, progress: float, frames: int) -> float:
        """Return how many updates of the schedule must be passed over with the next step of progress.

        Args:
            progress: Share of the schedule that is done.
            frames: Frames that the busiest worker has yet to register.
        """
        if self._limit is None:
            return 0.0
        updates_left = self._schedule.steps * (1 - progress)
        needed = sum(count * self._cost(part) for part, count in self._updates_left(progress))
        left = self._limit - self.seconds - self._registration(frames)
        if needed <= left:
            return 0.0
        pace = needed / left if left > 0 else updates_left
        return max(min(pace, updates_left) - 1, 0.0)

    def ends_registration(self, progress: float, frames: int) -> bool:
        """Return whether frames must stay without a map, because the updates need the time."""
        if self._limit is None or self._taken["registration"] < REGISTRATION_SHARE * self._limit:
            return False
        needed = sum(count * self._cost(part) for part, count in self._updates_left(progress))
        return self.seconds + frames * self._cost("registration") + needed > self._limit

    def _updates_left(self, progress: float) -> Iterator[tuple[Part, float]]:
        """Yield how many updates each part has yet to do."""
        schedule = self._schedule
        images = schedule.template_fraction + schedule.pretraining_fraction
        reduced = max(images, schedule.half_resolution_fraction)
        ends: dict[Part, float] = {
            "template": schedule.template_fraction, "pretraining": images, "reduced": reduced, "whole": 1.0,
        }  # fmt: skip
        begin = progress
        for part, end in ends.items():
            yield part, schedule.steps * max(end - begin, 0.0)
            begin = max(begin, end)

    def _registration(self, frames: int) -> float:
        """Return the seconds that registration will still take."""
        assert self._limit is not None
        most = max(REGISTRATION_SHARE * self._limit - self._taken["registration"], 0.0)
        return min(frames * self._cost("registration"), most)

    def _cost(self, part: Part) -> float:
        """Return the seconds of one update or frame: measured, or guessed by other parts; 0: unknown."""
        if self._count[part] >= _ENOUGH:
            return self._taken[part] / self._count[part]
        units = [
            self._taken[known] / count / _RELATIVE_COSTS[known]
            for known, count in self._count.items()
            if count >= _ENOUGH
        ]
        if not units:
            return 0.0
        least = self._network_seconds if part in ("pretraining", "reduced", "whole") else 0.0
        return max(_OPTIMISM * min(units) * _RELATIVE_COSTS[part], least)


def part_at(schedule: ScheduleConfig, progress: float) -> Part:
    """Return what an update at a progress in [0, 1) is part of."""
    now = schedule_at(schedule, progress)
    if now.stage in ("template", "pretraining"):
        return now.stage
    return "whole" if now.reduction == 1 else "reduced"
