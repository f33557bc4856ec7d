"""What a regression may know of a motion: where the legs are, how the pelvis moves, what it remembers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from dsar.body.model import JOINT_NAMES
from dsar.types import Body

_LEGS = ("left_knee", "right_knee", "left_ankle", "right_ankle")
_HEIGHTS, _RADIUS, _AROUND = (-0.05, -0.45), 0.3, 8
"""Metres: two rings of points around the rest pose's axis that the pelvis carries, at waist and hem."""
_SUBSTEPS = 8
_TURN_TIMES = (0.1, 0.3, 0.6)
"""Seconds over which rates of turning are averaged."""


@dataclass(frozen=True)
class Memory:
    """How a regression remembers what the points did."""

    means: Sequence[float] = ()
    """Time constants of running means, seconds."""
    oscillators: Sequence[tuple[float, float]] = ()
    """Period, seconds, and damping ratio of oscillators that each point drags along."""
    turning: bool = False
    """Running means of the rate of turning and of its square, too."""


def motion_features(
    body: Body, transforms: Float[Tensor, "f j 4 4"], fps: float, memory: Memory
) -> Float[ndarray, "f k"]:
    """Return features of every frame, in the pelvis's frame; no frame knows a later one.

    Before its first frame the body has stood in it.

    Args:
        body: Who moves.
        transforms: T_world_rest of its joints.
        fps: Frames a second.
        memory: What is remembered.
    """
    pelvis = transforms[:, 0].double().numpy()
    rings = np.einsum("fab,vb->fva", pelvis[:, :3, :3], _rings()) + pelvis[:, None, :3, 3]
    legs = leg_points(body, transforms)
    turn = pelvis[:, :3, :3]
    points = np.concatenate([rings, legs], 1)
    velocity = _differences(rings, fps)
    found = [
        local(turn, legs - pelvis[:, None, :3, 3]),
        turn[:, 1],
        local(turn, velocity) / 3,
        local(turn, _differences(velocity, fps)) / 30,
    ]
    found += [3 * local(turn, points - running_mean(points, time, fps)) for time in memory.means]
    found += [
        3 * local(turn, points - _drag_along(points, period, damping, fps))
        for period, damping in memory.oscillators
    ]
    if memory.turning:
        rate = turning_rate(turn, fps)
        for time in _TURN_TIMES:
            found += [running_mean(rate, time, fps) / 3, running_mean(rate**2, time, fps) / 15]
    return np.concatenate(found, 1)


def leg_points(body: Body, transforms: Float[Tensor, "f j 4 4"]) -> Float[ndarray, "f 4 3"]:
    """Return where knees and ankles are, world metres."""
    joints = [JOINT_NAMES.index(name) for name in _LEGS]
    turns, shifts = transforms[:, joints, :3, :3].double(), transforms[:, joints, :3, 3].double()
    return ((turns @ body.joints[joints].double()[..., None])[..., 0] + shifts).numpy()


def local(turn: Float[ndarray, "f 3 3"], vectors: Float[ndarray, "f v 3"]) -> Float[ndarray, "f k"]:
    """Return world vectors in a frame that turns, flat."""
    return np.einsum("fba,fvb->fva", turn, vectors).reshape(len(turn), -1)


def turning_rate(turn: Float[ndarray, "f 3 3"], fps: float) -> Float[ndarray, "f 3"]:
    """Return the rate at which a frame turns, about its own axes, rad/s; zero in the first."""
    step = np.einsum("fab,fac->fbc", turn[:-1], turn[1:])
    rate = np.zeros((len(turn), 3))
    rate[1:] = np.stack([step[:, 2, 1], step[:, 0, 2], step[:, 1, 0]], 1)
    rate[1:] -= np.stack([step[:, 1, 2], step[:, 2, 0], step[:, 0, 1]], 1)
    return rate * fps / 2


def running_mean(values: Float[ndarray, "f *v"], time: float, fps: float) -> Float[ndarray, "f *v"]:
    """Return exponential means over the past of a time constant, seconds."""
    keep = np.exp(-1 / (fps * time))
    means = np.empty_like(values)
    mean = values[0]
    for frame, value in enumerate(values):
        mean = keep * mean + (1 - keep) * value
        means[frame] = mean
    return means


def _drag_along(
    points: Float[ndarray, "f v 3"], period: float, damping: float, fps: float
) -> Float[ndarray, "f v 3"]:
    """Return where masses are that springs and dampers tie to points."""
    rate, step = 2 * np.pi / period, 1 / (fps * _SUBSTEPS)
    place, velocity, places = points[0], np.zeros_like(points[0]), np.empty_like(points)
    for frame, point in enumerate(points):
        for _ in range(_SUBSTEPS):
            velocity = velocity + step * (rate**2 * (point - place) - 2 * damping * rate * velocity)
            place = place + step * velocity
        places[frame] = place
    return places


def _differences(values: Float[ndarray, "f *v"], fps: float) -> Float[ndarray, "f *v"]:
    """Return changes a second; zero in the first frame."""
    return np.diff(values, axis=0, prepend=values[:1]) * fps


def _rings() -> Float[ndarray, "v 3"]:
    angles = torch.arange(_AROUND).double() * (2 * torch.pi / _AROUND)
    ring = torch.stack([_RADIUS * angles.sin(), 0 * angles, _RADIUS * angles.cos()], -1).numpy()
    return np.concatenate([ring + np.array([0, height, 0]) for height in _HEIGHTS])
