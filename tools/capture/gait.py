"""Feet that walk: from a path of the pelvis and a phase of the gait to where each foot is.

A foot stands while the pelvis passes over it and swings to its next place. Phase: one cycle is two steps, the
left foot strikes at whole numbers, the right one half a cycle later. Metres, radians, the stage's frame.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from capture.posing import Curve, Feet

WALKING = 0.28
"""Cycles from the strike to where the pelvis is over the foot, in a walk."""
BALL = 0.12
"""From the ankle forward to the ball of the foot, about which the heel rises."""
# Cycles after the strike and toes down in radians at full effort; the last is the next strike.
_PITCH = ((0.0, -0.28), (0.08, 0.0), (0.36, 0.0), (0.60, 0.62), (0.70, 0.55), (0.86, -0.05), (1.0, -0.28))


def plan_steps(
    phase: Curve,
    path: Float[ndarray, "f 2"],
    heading: Curve,
    *,
    effort: Curve,
    lift: Curve | float = 0.05,
    width: float = 0.085,
    stance: Curve | float = 0.62,
    middle: float = WALKING,
) -> Feet:
    """Return the feet of a gait.

    Args:
        phase: Cycles, never falling. Both feet stand where it is a whole or a half number and a bit more.
        path: The pelvis on the stage, x and z.
        heading: Yaw of the pelvis.
        effort: From 0 (feet hardly roll) to 1 (a brisk walk), scales the roll of the feet.
        lift: Height of a swinging foot.
        width: Of each foot from the middle.
        stance: Share of the cycle that a foot stands; under a half is a run.
        middle: Cycles after the strike at which the pelvis will be over the foot.
    """
    place, yaws, pitches = [], [], []
    for side, mirror in enumerate((1.0, -1.0)):
        own = phase + 0.5 * side
        cycle = np.floor(own + 1e-9)
        u = np.clip(own - cycle, 0, 1)
        s = np.clip((u - stance) / (1 - np.asarray(stance)), 0, 1)
        ahead = s - np.sin(2 * np.pi * s) / (2 * np.pi)
        track = np.concatenate([path, heading[:, None]], 1)
        now, following = (_footfalls(own, cycle + k, track, middle) for k in (0, 1))
        where = now + ahead[:, None] * (following - now)
        pitch = effort * np.interp(u, *np.array(_PITCH).T)
        yaw = where[:, 2] + mirror * 0.10
        roll = BALL * (1 - np.cos(pitch))
        x = where[:, 0] + mirror * width * np.cos(where[:, 2]) + roll * np.sin(yaw)
        z = where[:, 1] - mirror * width * np.sin(where[:, 2]) + roll * np.cos(yaw)
        height = lift * np.sin(np.pi * s**0.8) ** 2 + BALL * np.maximum(np.sin(pitch), -0.3 * np.sin(pitch))
        place.append(np.stack([x, height, z], -1))
        yaws.append(yaw)
        pitches.append(pitch)
    return Feet(np.stack(place, 1), np.stack(yaws, -1), np.stack(pitches, -1))


def _footfalls(
    own: Curve, cycle: Curve, track: Float[ndarray, "f 3"], middle: float
) -> Float[ndarray, "f 3"]:
    """Return the pelvis's track (x, z, yaw) as it is over a foot in the given cycle of each frame."""
    frames = np.arange(len(own))
    frame = np.interp(cycle + middle, own + 1e-9 * frames, frames)
    # Who stands at the beginning stands under the pelvis, whatever comes.
    frame = np.where(cycle <= np.floor(own[0] + 1e-9), 0.0, frame)
    return np.stack([np.interp(frame, frames, column) for column in track.T], -1)


def swing_body(curves: dict[str, Any], phase: Curve, effort: Curve) -> None:
    """Let pelvis, shoulders and arms go along with a gait, in place."""
    stride, sway = np.cos(2 * np.pi * phase), np.cos(2 * np.pi * (phase - WALKING))
    curves["heading"] = curves["heading"] - 0.09 * effort * stride
    curves["twist"] = curves["twist"] + 0.18 * effort * stride
    curves["swing"] = curves["swing"] + 0.42 * (effort * stride)[:, None] * np.array([-1.0, 1.0])
    curves["elbow"] = curves["elbow"] + 0.15 * effort[:, None]
    curves["shift"] = curves["shift"] + (0.022 * effort * sway)[:, None] * np.array([1.0, 0.0])
    curves["lean"] = curves["lean"] + (effort * 0.05)[:, None] * np.array([1.0, 0.0])
    curves["rise"] = curves["rise"] + effort * (0.012 * np.cos(4 * np.pi * (phase - WALKING)) - 0.015)
