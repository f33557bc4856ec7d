"""The stability battery: what a rollout does where rollouts fail. It needs no truth.

All cases look at the offsets of the control points, metres along the body's own axes, in which neither the
body's pose nor its place shows.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.rollout import network_outputs
from dsar.data.motions.files import resample
from dsar.evaluation.looping import loop_motion
from dsar.evaluation.stress_motions import change_future, spin_and_stop, sway_motion, teleport_motion
from dsar.network import NetworkOutput
from dsar.types import Motion

_MILLIMETRES = 1000.0
_NOISE = 0.02
"""Metres, rms, by which a twin's previous offsets are wrong."""
_MOVING_SHARE = 0.05
"""Share of its speed in the spin that cloth must keep a fifth of a second after the stop."""


@dataclass(frozen=True)
class CaseVerdict:
    """What a case found."""

    value: float
    """The worst that was seen, in the case's unit; infinite where something was not finite."""
    threshold: float
    """The largest value that passes."""
    unit: str
    """Unit of both."""
    curve: tuple[float, ...] = ()
    """How the value came about: over rounds, cycles or frames; see each case."""
    present: bool = True
    """Whether what must be there is there at all: a garment that never moves is no stable one."""

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
        value = self.value if math.isfinite(self.value) else None
        curve = [point if math.isfinite(point) else None for point in self.curve]
        verdict = {"pass": self.passed, "value": value, "threshold": self.threshold, "unit": self.unit}
        return verdict | {"present": self.present, "curve": curve}


@dataclass(frozen=True)
class BatteryVerdict:
    """What all cases found."""

    cases: Mapping[str, CaseVerdict]
    """By the case's name."""

    @property
    def survived(self) -> int:
        """How many cases hold."""
        return sum(verdict.passed for verdict in self.cases.values())

    def to_json(self) -> dict[str, Any]:
        """Return the verdicts for a results file."""
        cases = {name: verdict.to_json() for name, verdict in self.cases.items()}
        return {"cases": cases, "survived": self.survived, "tried": len(cases)}


Case = Callable[[Avatar, Motion], CaseVerdict]


def run_long(avatar: Avatar, motion: Motion, frames: int = 10_000) -> CaseVerdict:
    """A motion repeated for `frames` frames: change of the mean offset per 1000 frames, over its mean.

    Its slope is that of a line through the means of rounds; the curve is these means, mm.
    """
    _, period = loop_motion(motion, 1)
    rounds = max(3, -(-frames // period))
    sizes = torch.stack(
        [offset.norm(dim=-1).mean() for offset in _offsets(avatar, loop_motion(motion, rounds)[0])]
    )
    means = sizes.reshape(rounds, period).mean(1).double()
    centred = torch.arange(rounds, device=means.device) - (rounds - 1) / 2
    slope = (centred * means).sum() / centred.square().sum() * (1000 / period) / means.mean().clamp_min(1e-9)
    return CaseVerdict(_finite(slope.abs()), 0.01, "per 1000 frames", _curve(means * _MILLIMETRES))


def run_cycle(avatar: Avatar, motion: Motion, cycles: int = 100) -> CaseVerdict:
    """A pose that turns to and fro: rms difference of a cycle from the one before it, median from the 5th on.

    The curve is that difference, cycle by cycle, mm.
    """
    sway, period = sway_motion(motion, cycles)
    last: deque[Tensor] = deque(maxlen=period)
    distances = []
    for offset in _offsets(avatar, sway):
        if len(last) == period:
            distances.append(_distance(offset, last[0]))
        last.append(offset)
    apart = torch.stack(distances).reshape(cycles - 1, period).square().mean(1).sqrt()
    return CaseVerdict(_finite(apart[4:].median()), 0.5, "mm", _curve(apart))


@torch.no_grad()
def run_twin(avatar: Avatar, motion: Motion, start: int = 30) -> CaseVerdict:
    """Two rollouts, one of which is put wrong at a frame: seconds until they are 1 mm (rms) apart for good.

    It is given a bank of noise and offsets that are 2 cm (rms) wrong. The curve is their distance, mm.
    """
    long, _ = loop_motion(motion, 3)
    signal, generator = avatar.driving_signal(long), torch.Generator().manual_seed(0)
    state, apart = avatar.initial_state(2), []
    for frame in range(len(signal)):
        if frame == start:
            state = state.map(torch.clone)
            memory, offsets = state.memory[1], state.offsets[1]
            # Drawn in main memory: the same on any device.
            memory.copy_(_noise(memory, generator) * memory.square().mean().sqrt())
            offsets.add_(_NOISE * _noise(offsets, generator))
        motion_window = signal.windows[frame : frame + 1]
        cloth = signal.cloth_at([frame, frame])
        output, state, _ = avatar.forward_frame(motion_window.expand(2, -1, -1, -1, -1), state, cloth)
        if frame >= start:
            apart.append(_distance(*_at_control_points(avatar, output)))
    distances = torch.stack(apart)
    wrong = (~(distances < 1.0)).nonzero()
    seconds = torch.tensor((int(wrong[-1]) + 1) / avatar.fps if len(wrong) else 0.0)
    return CaseVerdict(_finite(seconds, distances), 3.0, "s", _curve(distances))


def run_teleport(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """A body that appears 10 m away and turned about in mid-motion: largest change of any offset.

    The curve is the largest change frame by frame, mm.
    """
    there = teleport_motion(motion, avatar.body.to(device="cpu"), len(motion) // 2)
    pairs = zip(_offsets(avatar, motion), _offsets(avatar, there), strict=True)
    apart = torch.stack([(one - other).norm(dim=-1).amax() for one, other in pairs]) * _MILLIMETRES
    return CaseVerdict(_finite(apart.amax()), 0.1, "mm", _curve(apart))


def run_stop(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """A spin that stops at once: rms distance from where the cloth ends up, 3 seconds later.

    After a fifth of a second it must still move at 5 % of its mean speed in the spin, or memory is not
    at work. The curve is the distance from the end, frame by frame from the stop on, mm.
    """
    spin, stop = spin_and_stop(motion)
    offsets = torch.stack(list(_offsets(avatar, spin)))
    speeds = _distance(offsets[1:], offsets[:-1])
    residual = _distance(offsets[stop:], offsets[-1:].expand_as(offsets[stop:]))
    present = bool(speeds[stop + round(0.2 * avatar.fps)] > _MOVING_SHARE * speeds[:stop].mean())
    late = residual[round(3 * avatar.fps) :].amax()
    return CaseVerdict(_finite(late), 1.0, "mm", _curve(residual), present)


def run_rate(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """The same motion at 15, 60 and 120 frames a second, resampled to the avatar's: largest rms difference.

    The curve is the difference at each of these rates, mm.
    """
    exact = torch.stack(list(_offsets(avatar, motion)))
    apart = []
    for rate in (0.5, 2, 4):
        there = resample(resample(motion, rate * motion.fps), avatar.fps)
        other = torch.stack(list(_offsets(avatar, there)))
        apart.append(_distance(exact[: len(other)], other).square().mean().sqrt())
    distances = torch.stack(apart)
    return CaseVerdict(_finite(distances.amax()), 2.0, "mm", _curve(distances))


def run_causal(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """Two futures of one past: largest difference before they part.

    The curve is the largest difference frame by frame, mm.
    """
    part = len(motion) // 2
    pairs = zip(_offsets(avatar, motion), _offsets(avatar, change_future(motion, part)), strict=True)
    apart = torch.stack([(one - other).abs().amax() for one, other in pairs]) * _MILLIMETRES
    return CaseVerdict(
        _finite(apart[:part].amax()), 0.0, "mm", _curve(apart), present=bool(apart[part:].amax() > 0)
    )


CASES: Mapping[str, Case] = {
    "long": run_long,
    "cycle": run_cycle,
    "twin": run_twin,
    "teleport": run_teleport,
    "stop": run_stop,
    "rate": run_rate,
    "causal": run_causal,
}


@torch.no_grad()
def stress(
    avatar: Avatar, motion: Motion, cases: Mapping[str, Case] = CASES
) -> Iterator[tuple[str, CaseVerdict]]:
    """Yield the verdict of each case on a motion at the avatar's frame rate."""
    for name, case in cases.items():
        yield name, case(avatar, motion)


def _offsets(avatar: Avatar, motion: Motion) -> Iterator[Float[Tensor, "p 3"]]:
    for _, output in network_outputs(avatar, motion):
        yield _at_control_points(avatar, output)[0].clone()


def _at_control_points(avatar: Avatar, output: NetworkOutput) -> Float[Tensor, "b p 3"]:
    return avatar.gather_control_points(output.offset)


def _distance(one: Float[Tensor, "*s p 3"], other: Float[Tensor, "*s p 3"]) -> Float[Tensor, "*s"]:
    """Return root mean square distances of the points, mm."""
    return (one - other).square().sum(-1).mean(-1).sqrt() * _MILLIMETRES


def _noise(like: Tensor, generator: torch.Generator) -> Tensor:
    """Return standard normal numbers of a host's generator, where a tensor of that shape is."""
    return torch.randn(like.shape, generator=generator).to(like.device)


def _finite(value: Tensor, also: Tensor | None = None) -> float:
    sound = value.isfinite().all() and (also is None or also.isfinite().all())
    return float(value) if sound else float("inf")


def _curve(values: Tensor) -> tuple[float, ...]:
    return tuple(round(value, 4) for value in values.tolist())
