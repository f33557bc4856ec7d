"""What can be computed of a rollout's stability without any case: gains, exponents, half-lives.

A rollout is a loop: offsets and hidden states go into the next frame. Where small errors in them shrink from
frame to frame it is stable on that motion, whatever the errors are.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.evaluation.settling import rms_speeds, settling_time
from dsar.evaluation.stops import SLOW
from dsar.evaluation.stress.motions import spin_and_stop
from dsar.evaluation.stress.rollouts import (
    MILLIMETRES,
    control_offsets,
    draw_noise,
    rms_distance,
    roll_offsets,
)
from dsar.evaluation.unseen import SPLITS
from dsar.network import NetworkState
from dsar.training.scene import Scene
from dsar.types import Motion

NUDGE = 1e-3
"""Metres, rms, by which a twin's offsets are wrong where its exponent is measured."""
BLOB, BLOB_RADIUS = 0.02, 0.15
"""Metres: height of a dent in the offsets, and how far around its middle it reaches."""
GAIN_FRAMES = 8
"""Frames of a motion, evenly spread, at which the gains are taken."""
GAIN_STEPS = 12
"""Steps of the power iteration."""
_FAINT = 1e-2
"""Share of a nudge below which rounding begins to count."""


@dataclass(frozen=True)
class Gain:
    """How much larger a small error of a stream is a frame later, over some frames of a motion."""

    largest: float
    """Of the frames, spectral norm."""
    mean: float
    """Likewise."""


@dataclass(frozen=True)
class Analysis:
    """What can be said of an avatar's stability by its equations and small errors."""

    loop_gain: Mapping[str, Gain]
    """By stream: `offsets` (d offsets / d previous offsets), and `memory` (d h / d previous h) of a bank."""
    lyapunov: Mapping[str, float]
    """By motion: the finite-time exponent, 1/s; negative where errors die out."""
    half_life: float
    """Seconds until a dent of 2 cm in the previous offsets is half as deep; infinite if it never is."""
    settle: float
    """Seconds from a stop until the garment is slower than a fifth of its speed after it."""
    overshoot: float
    """How far it swings on beyond where it comes to rest, mm (rms)."""

    def to_json(self) -> dict[str, Any]:
        """Return the figures for a results file, which knows no infinity: null."""
        return {
            "loop_gain": {
                stream: {"max": _finite(gain.largest), "mean": _finite(gain.mean)}
                for stream, gain in self.loop_gain.items()
            },
            "lyapunov_per_s": {name: _finite(value) for name, value in self.lyapunov.items()},
            "half_life_s": _finite(self.half_life),
            "settle_s": _finite(self.settle),
            "overshoot_mm": _finite(self.overshoot),
        }


def reported_motions(scene: Scene) -> dict[str, Motion]:
    """Return the motions that figures are reported on, by name: nothing is chosen by them."""
    names = [*scene.splits["test"], *scene.splits.get(SPLITS["test"], ())]
    return {name: scene.motions[name] for name in names}


def analyse(avatar: Avatar, motion: Motion, tests: Mapping[str, Motion]) -> Analysis:
    """Return the figures.

    Args:
        avatar: Any.
        motion: On which gains and half-life are taken, at the avatar's rate.
        tests: Motions of which each gets an exponent, likewise.
    """
    settle, overshoot = settle_after_spin(avatar, motion)
    return Analysis(
        loop_gain=loop_gains(avatar, motion),
        lyapunov={name: lyapunov_exponent(avatar, each) for name, each in tests.items()},
        half_life=half_life(avatar, motion),
        settle=settle,
        overshoot=overshoot,
    )


def loop_gains(avatar: Avatar, motion: Motion) -> dict[str, Gain]:
    """Return the largest and the mean spectral norm of a step's derivatives by its own streams.

    Below 1 everywhere, a step shrinks every small error of that stream, taken alone.
    """
    frames = torch.linspace(0, len(motion) - 1, min(GAIN_FRAMES, len(motion) - 1) + 1).long()[1:]
    signal, state, states = avatar.driving_signal(motion), avatar.initial_state(), []
    with torch.no_grad():
        for frame in range(len(signal)):
            if frame in frames:
                states.append(state)
            cloth = signal.cloth_at(range(frame, frame + 1))
            _, state, _ = avatar.forward_frame(signal.windows[frame : frame + 1], state, cloth)
    before = _stacked(states)
    windows, cloth = signal.windows[frames.tolist()], signal.cloth_at(frames.tolist())

    def step(state: NetworkState) -> tuple[Tensor, Tensor]:
        output, after, _ = avatar.forward_frame(windows, state, cloth)
        return output.offset, after.memory[:, -1]

    def by_offsets(newest: Tensor) -> Tensor:
        return step(dataclasses.replace(before, offsets=_with_newest(before.offsets, newest)))[0]

    def by_memory(newest: Tensor) -> Tensor:
        return step(dataclasses.replace(before, memory=_with_newest(before.memory, newest)))[1]

    gains = {"offsets": _spectral_norm(by_offsets, before.offsets[:, -1])}
    if avatar.network.bank is not None:
        gains["memory"] = _spectral_norm(by_memory, before.memory[:, -1])
    return {name: Gain(float(each.amax()), float(each.mean())) for name, each in gains.items()}


@torch.no_grad()
def lyapunov_exponent(avatar: Avatar, motion: Motion) -> float:
    """Return the largest finite-time exponent of twins that are nudged at three frames, 1/s.

    A twin's offsets are 1 mm (rms) wrong; ln(distance / first distance) over the time, until it is a
    hundredth or the motion ends. Minus infinity where a motion has no frame to be nudged in.
    """
    starts = sorted({max(1, share * len(motion) // 8) for share in (1, 3, 5)} & set(range(len(motion) - 1)))
    nudged = _nudged_distances(avatar, motion, starts)
    return max((_exponent(distances, avatar.fps) for distances in nudged), default=-math.inf)


def _exponent(distances: Float[Tensor, " f"], fps: float) -> float:
    ratios = distances[1:] / (NUDGE * MILLIMETRES)
    if not ratios.isfinite().all():
        return math.inf
    faint = (ratios < _FAINT).nonzero()
    end = int(faint[0]) if len(faint) else len(ratios) - 1
    return float(ratios[end].clamp_min(1e-12).log()) / ((end + 1) / fps)


def _nudged_distances(avatar: Avatar, motion: Motion, starts: list[int]) -> list[Float[Tensor, " f"]]:
    """Return, for each start, the distance of a nudged twin from the sound one, frame by frame, mm.

    The first is the nudge itself.
    """
    generator, count = torch.Generator().manual_seed(0), 1 + len(starts)
    signal, state = avatar.driving_signal(motion), avatar.initial_state(count)
    distances: list[list[Tensor]] = [[] for _ in starts]
    for frame in range(len(signal)):
        for twin, start in enumerate(starts, 1):
            if frame == start:
                state = state.map(torch.clone)
                newest = state.offsets[twin, -1]
                # Per point: a third of the square along each of the axes.
                newest.add_(NUDGE / 3**0.5 * draw_noise(newest, generator) * avatar.network.occupied[0])
                distances[twin - 1].append(newest.new_tensor(NUDGE * MILLIMETRES))
        window, cloth = signal.windows[frame : frame + 1], signal.cloth_at([frame] * count)
        output, state, _ = avatar.forward_frame(window.expand(count, -1, -1, -1, -1), state, cloth)
        offsets = control_offsets(avatar, output)
        for twin, start in enumerate(starts, 1):
            if frame >= start:
                distances[twin - 1].append(rms_distance(offsets[twin], offsets[0]))
    return [torch.stack(each) for each in distances]


@torch.no_grad()
def half_life(avatar: Avatar, motion: Motion) -> float:
    """Return the seconds until a dent in the previous offsets is half as deep, 1/3 into a motion.

    2 cm deep, on the garment where there is one; its distance from the sound rollout is measured over the
    points that it is on.
    """
    points = avatar.garment_control_points()
    points = points if len(points) else torch.arange(len(avatar.control.cells), device=avatar.device)
    places = avatar.control.points[points]
    dented = points[(places - places[len(places) // 2]).norm(dim=-1) < BLOB_RADIUS]
    dent = places.new_zeros(1, len(avatar.control.cells), 3)
    dent[0, dented] = BLOB / 3**0.5
    start, signal, state = len(motion) // 3, avatar.driving_signal(motion), avatar.initial_state(2)
    for frame in range(len(signal)):
        if frame == start:
            state = state.map(torch.clone)
            state.offsets[1, -1] += avatar.control.scatter(dent)[0]
        window, cloth = signal.windows[frame : frame + 1], signal.cloth_at([frame, frame])
        output, state, _ = avatar.forward_frame(window.expand(2, -1, -1, -1, -1), state, cloth)
        if frame >= start:
            depth = rms_distance(*control_offsets(avatar, output)[:, dented])
            if depth <= BLOB * MILLIMETRES / 2:
                return (frame - start + 1) / avatar.fps
    return math.inf


@torch.no_grad()
def settle_after_spin(avatar: Avatar, motion: Motion) -> tuple[float, float]:
    """Return the seconds in which the garment settles after a spin that stops, and its overshoot, mm."""
    spin, stop = spin_and_stop(motion)
    points = avatar.garment_control_points()
    offsets = roll_offsets(avatar, spin)
    offsets = offsets[:, points] if len(points) else offsets
    speeds = rms_speeds(offsets, avatar.fps)
    settle = settling_time(speeds, stop, len(offsets) - 1, SLOW * float(speeds[stop]), avatar.fps)
    onward, way = offsets[stop] - offsets[stop - 1], offsets[stop:] - offsets[-1]
    along = (way * onward).sum((-2, -1)) / onward.norm().clamp_min(1e-9) / len(onward) ** 0.5
    return settle, float(along.amax().clamp_min(0)) * MILLIMETRES


def _stacked(states: list[NetworkState]) -> NetworkState:
    """Return states of one rollout each as those of one batch."""
    return NetworkState(
        fresh=torch.cat([state.fresh for state in states]),
        window=tuple(torch.cat(level) for level in zip(*(state.window for state in states), strict=True)),
        motion=torch.cat([state.motion for state in states]),
        offsets=torch.cat([state.offsets for state in states]),
        memory=torch.cat([state.memory for state in states]),
    )


def _with_newest(entries: Tensor, newest: Tensor) -> Tensor:
    """Return a stream's entries of which the newest is another."""
    return torch.cat([entries[:, :-1], newest[:, None]], 1)


def _spectral_norm(function: Callable[[Tensor], Tensor], at: Float[Tensor, "b *s"]) -> Float[Tensor, " b"]:
    """Return the largest singular value of a function's Jacobian for each entry of a batch.

    By power iteration on J^T J; J v is the derivative of J^T u by u (Pearlmutter's trick turned round).
    """
    with torch.enable_grad():
        given = at.detach().clone().requires_grad_()
        value = function(given)
        weight = torch.zeros_like(value, requires_grad=True)
        (pulled,) = torch.autograd.grad(value, given, weight, create_graph=True)
    direction = draw_noise(at, torch.Generator().manual_seed(0))
    norms = at.new_zeros(len(at))
    for _ in range(GAIN_STEPS):
        direction = direction / _norms(direction).clamp_min(1e-30)
        (pushed,) = torch.autograd.grad(pulled, weight, direction, retain_graph=True)
        norms = _norms(pushed).flatten()
        (direction,) = torch.autograd.grad(value, given, pushed, retain_graph=True)
    return norms


def _norms(values: Float[Tensor, "b *s"]) -> Tensor:
    return values.flatten(1).norm(dim=1).reshape(-1, *[1] * (values.ndim - 1))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def describe_analysis(analysis: Analysis) -> list[str]:
    """Return lines for a person."""
    gains = ", ".join(f"{name} {gain.largest:.2f}" for name, gain in analysis.loop_gain.items())
    worst = max(analysis.lyapunov, key=lambda name: analysis.lyapunov[name])
    return [
        f"loop gain (below 1 small errors die out): {gains}",
        f"Lyapunov exponent, largest of {len(analysis.lyapunov)} motions: {analysis.lyapunov[worst]:.1f} "
        f"per s ({worst}); negative: errors die out",
        f"a dent of 2 cm is half as deep after {analysis.half_life:.2f} s; after a spin the garment settles "
        f"in {analysis.settle:.2f} s and swings on by {analysis.overshoot:.0f} mm",
    ]
