"""What the person does: eight training sequences, a nearby test and a far one with a one-to-many pair.

Every authored sequence is a `Score` made of keyed curves; two more are pieces of motion capture.
30 frames a second; angles in radians; the person stays at the centre of the stage.

Arms that rise in spins only would tell a model without memory that there is a spin. So most spins, the far
one among them, are danced with arms held out from the first frame to the last, and one sequence raises
the arms without any spin.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.posing import Curve, Score, compose_motion
from dsar.data.motions.files import read_motion
from dsar.types import Body, Motion

FPS = 30.0
MOCAP = {
    "turn_about": ("cmu_01_01", 212, 104, "train", ()),
    "walk": ("cmu_01_03", 1028, 88, "train", ()),
    "near": ("cmu_01_01", 476, 78, "test", ("nd",)),
}
"""Name: clip, first frame, frames, split, labels."""
DEGREE = np.pi / 180
Curves = dict[str, Any]
"""Fields of a `Score`, by name."""


@dataclass(frozen=True)
class Take:
    """One sequence to simulate and to render."""

    motion: Motion
    split: str
    labels: tuple[str, ...]


@dataclass(frozen=True)
class OneToMany:
    """Frames of one sequence with equal poses and different cloth; ranges include both ends."""

    sequence: str
    after_stop: tuple[int, int]
    at_rest: tuple[int, int]


def key_curve(frames: int, *keys: tuple[float, float]) -> Curve:
    """Return a curve through (frame, value) keys with eased steps between them, constant outside."""
    times, values = np.array(keys, float).T
    t = np.arange(frames)
    left = np.clip(np.searchsorted(times, t, side="right") - 1, 0, max(len(times) - 2, 0))
    right = np.minimum(left + 1, len(times) - 1)
    span = np.maximum(times[right] - times[left], 1e-9)
    u = np.clip((t - times[left]) / span, 0, 1)
    return values[left] + (values[right] - values[left]) * u * u * (3 - 2 * u)


def spin_curve(
    frames: int, *spins: tuple[int, float, float], ramp: int = 12, stop: int = 3
) -> tuple[Curve, list[int]]:
    """Return the heading of several spins and the frame at which each has stopped.

    Args:
        frames: Length of the curve.
        spins: (start frame, turns with sign, turns per second).
        ramp: Frames to reach the tempo.
        stop: Frames from tempo to standstill.
    """
    heading, ends = np.zeros(frames), []
    for start, turns, tempo in spins:
        cruise = max(1, round(abs(turns) * FPS / tempo - ramp / 2 - stop / 2))
        speed = np.concatenate(
            [
                0.5 - 0.5 * np.cos(np.pi * (np.arange(ramp) + 0.5) / ramp),
                np.ones(cruise),
                1 - (np.arange(stop) + 0.5) / stop,
            ]
        )
        travelled = np.cumsum(speed)
        travelled *= turns * 2 * np.pi / travelled[-1]
        end = start + len(speed)
        heading[start:end] += travelled
        heading[end:] += turns * 2 * np.pi
        ends.append(end - 1)
    return heading, ends


def wander(frames: int, rng: np.random.Generator, amplitude: float, period: float = 45.0) -> Curve:
    """Return slow natural variation: three sinusoids with random phases around the period in frames."""
    t = np.arange(frames)
    waves = [
        np.sin(2 * np.pi * t / (period * rng.uniform(0.6, 1.6)) + rng.uniform(0, 2 * np.pi)) for _ in range(3)
    ]
    return amplitude * np.sum(waves, 0) / 3


def stand_still(frames: int) -> Curves:
    """Return the curves of somebody who stands with the arms hanging."""
    ones = np.ones((frames, 2))
    return {
        "heading": np.zeros(frames),
        "rise": np.zeros(frames),
        "shift": 0 * ones,
        "abduction": 24 * DEGREE * ones,
        "swing": 0.05 * ones,
        "elbow": 18 * DEGREE * ones,
        "lean": 0 * ones,
        "twist": np.zeros(frames),
    }


def vary(curves: Curves, rng: np.random.Generator) -> None:
    """Add the slow variation of a living body to arms, trunk and pelvis, in place."""
    frames = len(curves["rise"])
    for name, amplitude in (("abduction", 0.06), ("swing", 0.10), ("elbow", 0.12), ("lean", 0.035)):
        curves[name] = curves[name] + np.stack([wander(frames, rng, amplitude) for _ in range(2)], -1)
    curves["shift"] = curves["shift"] + np.stack([wander(frames, rng, 0.012, 70) for _ in range(2)], -1)
    curves["twist"] = curves["twist"] + wander(frames, rng, 0.06)


def hold_arms(curves: Curves, raised: float, bent: float) -> None:
    """Hold the arms out from the first frame to the last, whatever the body does."""
    curves["abduction"] = np.full_like(curves["abduction"], raised)
    curves["elbow"] = curves["elbow"] + bent


def react_to_spin(curves: Curves, raised: float, bent: float) -> None:
    """Raise and trail the arms with the spin's speed, and let the shoulders lead into a turn."""
    speed = np.gradient(curves["heading"]) * FPS / (2 * np.pi)
    smooth = np.convolve(np.pad(np.abs(speed), 6, mode="edge"), np.hanning(15)[1:-1] / 7, "valid")
    effort = np.clip(smooth, 0, 1.2)[:, None]
    curves["abduction"] = curves["abduction"] + effort * (raised - 24 * DEGREE)
    curves["elbow"] = curves["elbow"] + effort * bent
    curves["rise"] = curves["rise"] - 0.015 * effort[:, 0]
    surge = np.convolve(np.pad(np.gradient(speed), 4, mode="edge"), np.hanning(11)[1:-1] / 5, "valid")
    curves["twist"] = curves["twist"] + np.clip(3.0 * surge, -0.35, 0.35)


def jump_curve(frames: int, start: int, height: float) -> Curve:
    """Return the pelvis rise of one jump: crouch, ballistic flight, give on landing."""
    half = np.sqrt(2 * height / 9.81) * FPS
    takeoff, landing = start + 9, start + 9 + 2 * half
    t = np.arange(frames)
    flight = height * (1 - ((t - takeoff - half) / half) ** 2)
    ground = key_curve(
        frames,
        (start, 0),
        (start + 6, -0.13),
        (takeoff, 0),
        (landing, 0),
        (landing + 4, -0.11),
        (landing + 15, 0),
    )
    return np.where((t > takeoff) & (t < landing), flight, ground)


def _sway(rng: np.random.Generator) -> Curves:
    frames = 100
    t = np.arange(frames)
    curves = stand_still(frames)
    ease = key_curve(frames, (4, 0), (20, 1), (76, 1), (86, 0))
    phase = 2 * np.pi * (t - 4) / 36
    curves["shift"][:, 0] = 0.10 * ease * np.sin(phase)
    curves["lean"][:, 1] = 0.10 * ease * np.sin(phase)
    curves["twist"] = 0.35 * ease * np.sin(phase + 0.4)
    curves["heading"] = 0.30 * ease * np.sin(phase)
    curves["rise"] = -0.03 * ease * np.cos(phase) ** 2
    curves["swing"] = ease[:, None] * 0.55 * np.stack([np.sin(phase), -np.sin(phase)], -1)
    raised = key_curve(frames, (24, 0), (38, 1), (58, 1), (72, 0))[:, None]
    curves["abduction"] = curves["abduction"] + raised * 30 * DEGREE
    curves["elbow"] = curves["elbow"] + 0.25 * ease[:, None]
    vary(curves, rng)
    return curves


def _spin(
    frames: int,
    spins: list[tuple[int, float, float]],
    arms: Callable[[Curves, float, float], None],
    raised: float,
    bent: float,
    rng: np.random.Generator,
) -> Curves:
    curves = stand_still(frames)
    curves["heading"], _ = spin_curve(frames, *spins)
    arms(curves, raised * DEGREE, bent)
    vary(curves, rng)
    return curves


def _twists(rng: np.random.Generator) -> Curves:
    frames = 112
    curves = stand_still(frames)
    half = np.pi
    curves["heading"] = key_curve(
        frames, (6, 0), (19, half), (30, half), (43, 0), (56, 0), (66, -half), (78, -half), (88, 0)
    )
    react_to_spin(curves, 40 * DEGREE, 0.5)
    vary(curves, rng)
    return curves


def _jumps(rng: np.random.Generator) -> Curves:
    frames = 104
    curves = stand_still(frames)
    curves["rise"] = jump_curve(frames, 6, 0.16) + jump_curve(frames, 58, 0.22)
    crouch = np.clip(-curves["rise"], 0, 1)[:, None]
    curves["lean"] = curves["lean"] + crouch * np.array([2.2, 0.0])
    curves["swing"] = curves["swing"] - 3.0 * crouch + 2.0 * np.clip(curves["rise"], 0, 1)[:, None]
    curves["heading"] = key_curve(frames, (60, 0), (80, 0.5), (90, 0.5))
    vary(curves, rng)
    return curves


def _spin_and_jump(rng: np.random.Generator) -> Curves:
    frames = 118
    curves = stand_still(frames)
    curves["heading"], ends = spin_curve(frames, (6, 1.0, 1.3))
    hold_arms(curves, 42 * DEGREE, 0.3)
    curves["rise"] = curves["rise"] + jump_curve(frames, ends[0] + 26, 0.18)
    vary(curves, rng)
    return curves


def _far() -> tuple[Curves, OneToMany]:
    frames = 160
    curves = stand_still(frames)
    curves["heading"], ends = spin_curve(frames, (20, 2.0, 1.5))
    hold_arms(curves, 50 * DEGREE, 0.35)
    stop = ends[0]
    curves["rise"] = curves["rise"] + jump_curve(frames, stop + 46, 0.18)
    return curves, OneToMany("far", (stop, stop + 44), (0, 12))


def cut_mocap(path: Path, body: Body, first: int, frames: int, name: str) -> Motion:
    """Return a piece of a clip with the middle of its walked area over the stage's centre."""
    piece = read_motion(path, body).slice(first, first + frames)
    pelvis = piece.translations + body.joints[0]
    middle = 0.5 * (pelvis.amin(0) + pelvis.amax(0))
    middle[1] = 0.0
    return dataclasses.replace(piece, translations=piece.translations - middle, name=name)


def choreograph(body: Body, clips: Path, seed: int) -> tuple[Mapping[str, Take], OneToMany]:
    """Return all takes by sequence name, and the pair of equal poses with different cloth.

    Args:
        body: The embedded body; its rest joints and soles scale the motion.
        clips: Folder of the motion-capture clips `cmu_01_01.npz` and `cmu_01_03.npz`.
        seed: Of the natural variation; the test sequence `far` has none.
    """
    rng = np.random.default_rng(seed)
    far, pair = _far()
    train = {
        "sway": _sway(rng),
        "spin_left": _spin(98, [(8, 1.5, 1.2)], hold_arms, 62, 0.2, rng),
        "spin_right": _spin(100, [(8, -2.0, 1.6)], react_to_spin, 38, 0.9, rng),
        "spin_both": _spin(138, [(6, 1.0, 0.8), (78, -1.0, 1.4)], hold_arms, 50, 0.5, rng),
        "twists": _twists(rng),
        "jumps": _jumps(rng),
        "spin_jump": _spin_and_jump(rng),
    }
    joints = body.joints.double().numpy()
    ground = float(body.vertices[:, 1].min())
    takes = {
        name: Take(compose_motion(Score(**curves), joints, ground, FPS, name), "train", ())
        for name, curves in train.items()
    }
    for name, (clip, first, frames, split, labels) in MOCAP.items():
        piece = cut_mocap(clips / f"{clip}.npz", body, first, frames, name)
        takes[name] = Take(piece, split, labels)
    takes["far"] = Take(compose_motion(Score(**far), joints, ground, FPS, "far"), "test", ("fd",))
    return takes, pair
