"""Motions of kinds that the training sequences do not have; only their garment is simulated, no images.

One half is for choosing between methods (`unseen_validation`), the other is only ever reported
(`unseen_test`). Both have walks, turns, spins, stops and small motions, yet never the same one.
Conventions as in `capture.choreography`.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from capture.choreography import (
    DEGREE,
    FPS,
    Curves,
    Take,
    cut_mocap,
    hold_arms,
    key_curve,
    react_to_spin,
    spin_curve,
    stand_still,
    vary,
)
from capture.gait import plan_steps, swing_body
from capture.posing import Curve, Feet, Score, compose_motion
from dsar.types import Body

VALIDATION, TEST = "unseen_validation", "unseen_test"
PIECES = {
    "walk_curve": ("cmu_01_03", 0, 84, VALIDATION),
    "turn_off": ("cmu_01_03", 368, 76, VALIDATION),
    "leap": ("cmu_01_01", 346, 82, VALIDATION),
    "walk_turn": ("cmu_01_03", 532, 80, TEST),
    "turn_and_go": ("cmu_01_03", 872, 70, TEST),
}
"""Name: clip, first frame, frames, split. All are a second or more away from what trains and from `near`."""


def _feet(*keys: tuple[Curve, Curve, Curve], yaw: Float[ndarray, "f 2"], pitch: tuple[Curve, Curve]) -> Feet:
    """Return feet whose places are given as curves x, y, z of the left and of the right one."""
    place = np.stack([np.stack(np.broadcast_arrays(*curves), -1) for curves in keys], 1)
    return Feet(place, yaw, np.stack(np.broadcast_arrays(*pitch), -1))


def _toes_out(heading: Curve) -> Float[ndarray, "f 2"]:
    return heading[:, None] + np.array([0.14, -0.14])


def _integrate(speed: Curve, heading: Curve) -> Float[ndarray, "f 2"]:
    """Return the path of somebody who walks ahead at a speed in m/s."""
    direction = np.stack([np.sin(heading), np.cos(heading)], -1)
    path = np.cumsum(speed[:, None] * direction / FPS, 0)
    return path - 0.5 * (path.min(0) + path.max(0))


def _squat(rng: np.random.Generator) -> Curves:
    frames = 116
    curves = stand_still(frames)
    down = key_curve(frames, (8, 0), (28, 1), (42, 1), (58, 0), (68, 0), (80, 0.7), (84, 0.7), (98, 0))
    curves["rise"] = -0.40 * down
    curves["shift"][:, 1] = -0.13 * down
    curves["lean"][:, 0] = 0.85 * down
    curves["swing"] = curves["swing"] + 1.1 * down[:, None]
    vary(curves, rng)
    return curves


def _slow_spin(frames: int, turns: float, tempo: float, raised: float, rng: np.random.Generator) -> Curves:
    curves = stand_still(frames)
    curves["heading"], _ = spin_curve(frames, (8, turns, tempo), ramp=20, stop=10)
    hold_arms(curves, raised * DEGREE, 0.3)
    vary(curves, rng)
    return curves


def _fast_spin(rng: np.random.Generator) -> Curves:
    frames = 92
    curves = stand_still(frames)
    curves["heading"], _ = spin_curve(frames, (8, 2.0, 2.1), ramp=9)
    react_to_spin(curves, 30 * DEGREE, 0.5)
    vary(curves, rng)
    return curves


def _pirouette(rng: np.random.Generator) -> Curves:
    """Three turns on the left foot, the right one drawn up to the knee, and an abrupt stop."""
    frames = 108
    curves = stand_still(frames)
    heading, (end,) = spin_curve(frames, (14, -3.0, 1.9), ramp=8)
    drawn = key_curve(frames, (8, 0), (18, 1), (end - 4, 1), (end + 5, 0))
    curves["heading"] = heading
    curves["rise"] = 0.02 * drawn
    curves["shift"][:, 0] = 0.095 * drawn
    curves["abduction"] = curves["abduction"] + (40 * DEGREE * key_curve(frames, (2, 0), (12, 1)))[:, None]
    curves["elbow"] = curves["elbow"] + 1.0 * drawn[:, None]
    side, front = np.array([np.cos(heading), -np.sin(heading)]), np.array([np.sin(heading), np.cos(heading)])
    left = 0.095 * side
    right = -(0.105 - 0.14 * drawn) * side + 0.10 * drawn * front
    curves["feet"] = _feet(
        (left[0], 0.05 * drawn, left[1]),
        (right[0], 0.34 * drawn, right[1]),
        yaw=_toes_out(heading),
        pitch=(0.4 * drawn, 0.8 * drawn),
    )
    vary(curves, rng)
    return curves


def _walk_and_stop(rng: np.random.Generator) -> Curves:
    frames = 124
    curves = stand_still(frames)
    pace = key_curve(frames, (6, 0), (20, 1), (64, 1), (73, 0))
    phase = 0.06 + np.cumsum(key_curve(frames, (4, 0), (12, 1), (70, 1), (84, 0))) * 0.95 / FPS
    return _go(curves, 1.25 * pace, np.zeros(frames), _to_standing(phase), pace, rng)


def _jog_and_stop(rng: np.random.Generator) -> Curves:
    frames = 112
    curves = stand_still(frames)
    pace = key_curve(frames, (6, 0), (24, 1), (58, 1), (70, 0))
    steps = key_curve(frames, (4, 0), (12, 1), (66, 1), (82, 0))
    phase = _to_standing(0.06 + np.cumsum(steps) * 1.3 / FPS)
    curves["rise"] = -0.03 * pace * np.cos(4 * np.pi * (phase - 0.18))
    curves["elbow"] = curves["elbow"] + 1.1 * pace[:, None]
    curves["lean"][:, 0] = 0.12 * pace - 0.10 * key_curve(frames, (56, 0), (64, 1), (78, 0))
    lift = 0.05 + 0.16 * pace
    return _go(
        curves,
        2.3 * pace,
        np.zeros(frames),
        phase,
        pace,
        rng,
        lift=lift,
        stance=0.62 - 0.24 * pace,
        middle=0.19,
    )


def _to_standing(phase: Curve) -> Curve:
    """Return a phase stretched a little so that it ends with both feet on the ground."""
    end = np.ceil(2 * (phase[-1] - 0.06)) / 2 + 0.06
    return phase[0] + (phase - phase[0]) * (end - phase[0]) / (phase[-1] - phase[0])


def _go(
    curves: Curves,
    speed: Curve,
    heading: Curve,
    phase: Curve,
    effort: Curve,
    rng: np.random.Generator,
    **steps: Any,
) -> Curves:
    """Complete curves by a walk ahead; `steps` are those of `plan_steps`."""
    curves["travel"] = _integrate(speed, heading)
    curves["feet"] = plan_steps(phase, curves["travel"], heading, effort=effort, **steps)
    curves["heading"] = heading
    swing_body(curves, phase, effort)
    vary(curves, rng)
    return curves


def _stumble(rng: np.random.Generator) -> Curves:
    """Somebody who walks, catches a foot, lurches, and saves herself by two quick steps."""
    frames = 110
    curves = stand_still(frames)
    caught = 46
    pace = key_curve(frames, (4, 0), (16, 1), (caught, 1), (caught + 4, 0.7), (caught + 10, 1.7),
                     (caught + 20, 0.9), (caught + 32, 0))  # fmt: skip
    steps = key_curve(frames, (3, 0), (10, 0.9), (caught, 0.9), (caught + 3, 0.5), (caught + 8, 1.5),
                      (caught + 24, 1.2), (caught + 40, 0))  # fmt: skip
    lurch = key_curve(frames, (caught, 0), (caught + 8, 1), (caught + 16, 0.8), (caught + 34, 0))
    curves["lean"][:, 0] = 0.75 * lurch
    curves["lean"][:, 1] = 0.12 * lurch
    curves["rise"] = -0.09 * lurch
    curves["abduction"] = curves["abduction"] + 55 * DEGREE * lurch[:, None]
    curves["swing"] = curves["swing"] + 0.5 * lurch[:, None]
    phase = _to_standing(0.06 + np.cumsum(steps) / FPS)
    effort = np.minimum(pace, 1.0)
    return _go(curves, pace, 0.25 * lurch, phase, effort, rng, lift=0.05 + 0.05 * lurch)


def _start_stop_turn(rng: np.random.Generator) -> Curves:
    """Two steps, a stop, a turn to the left on the spot, a stop, two steps."""
    frames = 140
    curves = stand_still(frames)
    pace = key_curve(frames, (6, 0), (16, 1), (30, 1), (38, 0), (86, 0), (96, 1), (110, 1), (118, 0))
    heading = key_curve(frames, (54, 0), (74, 0.62 * np.pi))
    stepping = key_curve(frames, (4, 0), (10, 1), (40, 1), (48, 0), (52, 0), (56, 1), (74, 1), (80, 0),
                         (83, 0), (90, 1), (118, 1), (126, 0))  # fmt: skip
    phase = _to_standing(0.06 + np.cumsum(stepping) * 0.95 / FPS)
    return _go(curves, 1.0 * pace, heading, phase, 0.9 * pace, rng)


def _march(rng: np.random.Generator) -> Curves:
    frames = 110
    curves = stand_still(frames)
    steps = key_curve(frames, (6, 0), (14, 1), (82, 1), (92, 0))
    phase = _to_standing(0.06 + np.cumsum(steps) * 0.95 / FPS)
    return _go(curves, np.zeros(frames), np.zeros(frames), phase, 0.7 * steps, rng, lift=0.22 * steps)


def _side_steps(rng: np.random.Generator) -> Curves:
    frames = 120
    curves = stand_still(frames)
    along = key_curve(frames, (6, 0), (50, 0.40), (58, 0.40), (102, 0.0)) - 0.20
    steps = key_curve(frames, (4, 0), (10, 1), (96, 1), (108, 0))
    phase = _to_standing(0.06 + np.cumsum(steps) * 0.85 / FPS)
    curves["travel"] = np.stack([along, np.zeros(frames)], -1)
    gentle = 0.35 * steps
    curves["feet"] = plan_steps(phase, curves["travel"], np.zeros(frames), effort=gentle, width=0.13)
    curves["lean"][:, 1] = -0.05 * np.gradient(along) * FPS
    swing_body(curves, phase, 0.3 * gentle)
    vary(curves, rng)
    return curves


def _waltz(rng: np.random.Generator) -> Curves:
    """Box steps that turn to the left: forward, side, close, back, side, close, three steps a second."""
    frames = 144
    curves = stand_still(frames)
    beat = 0.32 * FPS
    t = (np.arange(frames) - 8) / beat
    corners = np.array([(0, 0), (0, 0.34), (0.30, 0.40), (0.30, 0.40), (0.26, 0.06), (0, 0), (0, 0)])
    waltzing = np.clip(t, 0, 12)
    turn = 0.5 * np.pi * waltzing / 6
    box = [np.interp(waltzing % 6, np.arange(7), column) for column in corners.T]
    softly = np.hanning(11)[1:-1] / np.hanning(11).sum()
    path = np.stack([np.convolve(np.pad(c, 4, mode="edge"), softly, "valid") for c in box], -1)
    danced = key_curve(frames, (4, 0), (14, 1), (8 + 11 * beat, 1), (8 + 13 * beat, 0))
    phase = _to_standing(0.06 + np.cumsum(danced) / (2 * beat))
    heading = np.convolve(np.pad(turn, 4, mode="edge"), softly, "valid").astype(float)
    curves["travel"], curves["heading"] = path - path.mean(0), heading
    curves["feet"] = plan_steps(phase, curves["travel"], heading, effort=0.6 * danced, width=0.1)
    curves["rise"] = danced * (0.02 - 0.045 * np.cos(2 * np.pi * waltzing / 3))
    curves["lean"][:, 1] = 0.05 * danced * np.sin(2 * np.pi * waltzing / 6)
    hold_arms(curves, 62 * DEGREE, 0.7)
    curves["swing"] = curves["swing"] + 0.45
    vary(curves, rng)
    return curves


def _kick(rng: np.random.Generator) -> Curves:
    """A kick ahead with the right leg, then one with the left."""
    frames = 112
    curves = stand_still(frames)
    legs, pitches, shift = [], [], np.zeros(frames)
    for mirror, start in ((1.0, 56), (-1.0, 8)):
        keys = [start + k for k in (0, 8, 17, 21, 32, 40)]
        ahead = key_curve(frames, *zip(keys, (0, -0.22, 0.66, 0.66, 0.1, 0), strict=True))
        high = key_curve(frames, *zip(keys, (0, 0.16, 0.62, 0.60, 0.10, 0), strict=True))
        pitches.append(key_curve(frames, *zip(keys, (0, 0.6, 0.1, 0.0, 0.2, 0), strict=True)))
        legs.append((mirror * 0.105 * np.ones(frames), high, ahead))
        stands = key_curve(frames, (start - 6, 0), (start + 6, 1), (start + 30, 1), (start + 42, 0))
        shift -= mirror * 0.085 * stands
        curves["swing"][:, 0] -= mirror * 0.6 * np.clip(ahead, -0.3, 0.7)
        curves["swing"][:, 1] += mirror * 0.6 * np.clip(ahead, -0.3, 0.7)
        curves["lean"][:, 0] -= 0.28 * np.clip(ahead, -0.2, 0.7)
    curves["shift"][:, 0] = shift
    curves["abduction"] = curves["abduction"] + 15 * DEGREE
    curves["feet"] = _feet(*legs, yaw=_toes_out(np.zeros(frames)), pitch=(pitches[0], pitches[1]))
    vary(curves, rng)
    return curves


def _curtsey(rng: np.random.Generator) -> Curves:
    """The right foot goes behind the left one, both knees bend, and back."""
    frames = 104
    curves = stand_still(frames)
    behind = key_curve(frames, (8, 0), (24, 1), (70, 1), (86, 0))
    carried = np.sin(np.pi * behind) ** 2
    down = key_curve(frames, (18, 0), (40, 1), (50, 1), (70, 0))
    curves["rise"] = -0.22 * down
    curves["shift"][:, 0] = 0.05 * behind
    curves["shift"][:, 1] = -0.08 * behind
    curves["lean"][:, 0] = 0.35 * down
    curves["twist"] = 0.12 * down
    curves["abduction"] = curves["abduction"] + 24 * DEGREE * behind[:, None]
    left = (0.105 * np.ones(frames), np.zeros(frames), np.zeros(frames))
    right = (-0.105 + 0.22 * behind, 0.05 * carried + 0.09 * behind, -0.30 * behind)
    curves["feet"] = _feet(left, right, yaw=_toes_out(np.zeros(frames)), pitch=(0 * behind, 0.75 * behind))
    vary(curves, rng)
    return curves


def _hip_circle(rng: np.random.Generator) -> Curves:
    frames = 110
    curves = stand_still(frames)
    ease = key_curve(frames, (4, 0), (18, 1), (84, 1), (94, 0))
    turn = 2 * np.pi * (np.arange(frames) - 4) / 38
    circle = np.stack([np.sin(turn), np.cos(turn)], -1) * ease[:, None]
    curves["shift"] = 0.085 * circle
    curves["lean"] = 0.22 * np.stack([-circle[:, 1], circle[:, 0]], -1)
    curves["rise"] = -0.03 * ease
    curves["heading"] = 0.10 * circle[:, 0]
    curves["abduction"] = curves["abduction"] + 16 * DEGREE
    curves["elbow"] = curves["elbow"] + 0.9 * ease[:, None]
    vary(curves, rng)
    return curves


def _arms(rng: np.random.Generator) -> Curves:
    """Arms rise, reach and swing; all else stays."""
    frames = 100
    curves = stand_still(frames)
    up = key_curve(frames, (6, 0), (22, 1), (30, 1), (42, 0))
    reach = key_curve(frames, (46, 0), (56, 1), (62, -0.3), (72, 0.8), (84, 0))
    curves["abduction"] = curves["abduction"] + 105 * DEGREE * up[:, None]
    curves["swing"] = curves["swing"] + 1.2 * reach[:, None] * np.array([1.0, -0.5])
    curves["elbow"] = curves["elbow"] + 0.5 * np.abs(reach)[:, None]
    vary(curves, rng)
    return curves


AUTHORED: Mapping[str, tuple[str, Callable[[np.random.Generator], Curves]]] = {
    "squat": (VALIDATION, _squat),
    "spin_slow": (VALIDATION, lambda rng: _slow_spin(112, 1.0, 0.42, 20, rng)),
    "spin_fast": (VALIDATION, _fast_spin),
    "walk_stop": (VALIDATION, _walk_and_stop),
    "arms": (VALIDATION, _arms),
    "march": (VALIDATION, _march),
    "side_steps": (VALIDATION, _side_steps),
    "start_stop_turn": (VALIDATION, _start_stop_turn),
    "kick": (TEST, _kick),
    "waltz": (TEST, _waltz),
    "slow_turn": (TEST, lambda rng: _slow_spin(110, -1.25, 0.55, 75, rng)),
    "pirouette": (TEST, _pirouette),
    "jog_stop": (TEST, _jog_and_stop),
    "stumble": (TEST, _stumble),
    "curtsey": (TEST, _curtsey),
    "hip_circle": (TEST, _hip_circle),
}


def choreograph_unseen(body: Body, clips: Path, seed: int) -> dict[str, Take]:
    """Return the unseen motions by name.

    Args:
        body: The embedded body; its rest joints and soles scale the motion.
        clips: Folder of the motion-capture clips `cmu_01_01.npz` and `cmu_01_03.npz`.
        seed: Of the natural variation, which each motion has of its own.
    """
    takes = {}
    for name, (clip, first, frames, split) in PIECES.items():
        takes[name] = Take(cut_mocap(clips / f"{clip}.npz", body, first, frames, name), split, ())
    joints, ground = body.joints.double().numpy(), float(body.vertices[:, 1].min())
    for name, (split, author) in AUTHORED.items():
        curves = author(np.random.default_rng([seed, *name.encode()]))
        takes[name] = Take(compose_motion(Score(**curves), joints, ground, FPS, name), split, ())
    return takes
