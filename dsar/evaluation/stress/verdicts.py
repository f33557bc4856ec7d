"""What a case of the stability battery found, and why its threshold is where it is."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.types import Gaussians, Motion


@dataclass(frozen=True)
class Moment:
    """Some frames of a rollout as they look, posed in main memory."""

    frames: tuple[int, ...]
    """Of the case's motion, counted from 0, ascending."""
    gaussians: tuple[Gaussians, ...]
    """One for each."""


@dataclass(frozen=True)
class CaseVerdict:
    """What a case found."""

    value: float
    """The worst that was seen, in the case's unit; infinite where something was not finite."""
    threshold: float
    """The largest value that passes."""
    unit: str
    """Unit of both."""
    reason: str
    """Why the threshold is where it is: a sentence."""
    curve: tuple[float, ...] = ()
    """How the value came about: over rounds, cycles, frames or motions; see each case."""
    present: bool = True
    """Whether what must be there is there at all: a garment that never moves is no stable one."""
    frame: int | None = None
    """The worst frame, counted from 0 in the case's motion, where there is one."""
    details: Mapping[str, float] = field(default_factory=dict)
    """What else was measured on the way, its unit in its name."""
    moment: Moment | None = field(default=None, compare=False, repr=False)
    """How the worst moment looks."""

    @property
    def passed(self) -> bool:
        """Whether the case holds."""
        return self.present and self.value <= self.threshold

    def describe(self) -> str:
        """Return a line for a person."""
        line = f"{self.value:.3g} (at most {self.threshold:g}) {self.unit}"
        return line if self.present else f"{line}; what must be there is not"

    def to_json(self) -> dict[str, Any]:
        """Return the verdict for a results file, which knows no infinity: null."""
        verdict = {"pass": self.passed, "value": _number(self.value), "threshold": self.threshold}
        return verdict | {
            "unit": self.unit,
            "reason": self.reason,
            "present": self.present,
            "frame": self.frame,
            "details": {key: _number(value) for key, value in self.details.items()},
            "curve": [_number(point) for point in self.curve],
        }


@dataclass(frozen=True)
class BatteryVerdict:
    """What all cases found."""

    cases: Mapping[str, CaseVerdict]
    """By the case's name."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """What each case took, as far as that is known."""

    @property
    def survived(self) -> int:
        """How many cases hold."""
        return sum(verdict.passed for verdict in self.cases.values())

    def to_json(self) -> dict[str, Any]:
        """Return the verdicts for a results file."""
        cases = {
            name: verdict.to_json() | {"seconds": self.seconds.get(name)}
            for name, verdict in self.cases.items()
        }
        return {"cases": cases, "survived": self.survived, "tried": len(cases)}


Case = Callable[[Avatar, Motion], CaseVerdict]
"""Drives an avatar by what it makes of a motion at the avatar's frame rate."""


def sound(value: Tensor, *others: Tensor) -> float:
    """Return a value; infinite where it, or anything of others, is not finite."""
    return float(value) if all(each.isfinite().all() for each in (value, *others)) else math.inf


def rounded(values: Tensor) -> tuple[float, ...]:
    """Return the points of a curve."""
    return tuple(round(value, 4) for value in values.tolist())


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
