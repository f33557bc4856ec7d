"""From a handful of readable curves (heading, height, arms, lean) to SMPL-X joint rotations.

Feet are planted by two-bone inverse kinematics; they step when the heading leaves them behind, or go where
the score says (`capture.gait` plans them for walks).
World: metres, Y up, person facing +Z at heading zero, angles in radians.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import NDArray

from dsar.geometry.rotations import axis_angle_from_matrix
from dsar.types import Motion

PELVIS, NECK, HEAD = 0, 12, 15
SPINES = (3, 6, 9)
LEGS = ((1, 4, 7), (2, 5, 8))  # hip, knee, ankle of the left and of the right leg
ARMS = ((16, 18, 20), (17, 19, 21))  # shoulder, elbow, wrist
FINGERS = (range(25, 37), range(40, 52))  # without thumbs
STEP = np.pi / 2
"""Turn after which a foot is set down anew; divides a full turn."""
Curve = NDArray[np.float64]


@dataclass(frozen=True)
class Feet:
    """Where both feet are over time, left and right in the second axis; the stage's frame, Y up."""

    place: Float[ndarray, "f 2 3"]
    """Ankles: x and z on the stage, y above where they are in standing; metres."""
    yaw: Float[ndarray, "f 2"]
    """Where the toes point, radians, as the heading."""
    pitch: Float[ndarray, "f 2"]
    """How far the toes point down (below zero: up), radians."""


@dataclass(frozen=True)
class Score:
    """The curves of one authored sequence, one value a frame; left and right where there are two columns."""

    heading: Float[ndarray, " f"]
    """Yaw of the pelvis, radians, continuous over whole turns."""
    rise: Float[ndarray, " f"]
    """Pelvis height above standing, metres: negative in a crouch, positive in flight."""
    shift: Float[ndarray, "f 2"]
    """Pelvis displacement over the feet along the body's side and front, metres."""
    abduction: Float[ndarray, "f 2"]
    """Angle of the upper arms off the body."""
    swing: Float[ndarray, "f 2"]
    """Forward swing of the arms."""
    elbow: Float[ndarray, "f 2"]
    """Flexion of the elbows."""
    lean: Float[ndarray, "f 2"]
    """Bend of the trunk forward and to the left."""
    twist: Float[ndarray, " f"]
    """Yaw of the shoulders against the pelvis."""
    travel: Float[ndarray, "f 2"] | None = None
    """Way of the pelvis on the stage, x and z in metres; None stays in the centre."""
    feet: Feet | None = None
    """Feet that go where they should; None stands in the centre and steps under the heading."""


def rotate(axis: int, angle: Float[ndarray, " f"]) -> Float[ndarray, "f 3 3"]:
    """Return rotations about world axis 0, 1 or 2 (right-handed)."""
    matrix = np.tile(np.eye(3), (len(angle), 1, 1))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[:, i, i] = matrix[:, j, j] = np.cos(angle)
    matrix[:, i, j], matrix[:, j, i] = -np.sin(angle), np.sin(angle)
    return matrix


def _wrap_angle(angle: Curve) -> Curve:
    """Return angles in [-pi, pi), rounded so that whole turns give the very same bits."""
    return np.round(np.remainder(angle + np.pi, 2 * np.pi) - np.pi, 9)


def compose_motion(
    score: Score, joints: Float[ndarray, "j 3"], ground: float, fps: float, name: str
) -> Motion:
    """Return the SMPL-X motion of a score.

    Args:
        score: The curves.
        joints: Rest joints of the body in metres (55, SMPL-X order, T-pose facing +Z).
        ground: Height of the soles in the rest pose; they stand on y = 0 in the result.
        fps: Frame rate.
        name: Label of the motion.
    """
    frames = len(score.heading)
    local = np.tile(np.eye(3), (frames, len(joints), 1, 1))
    yaw = rotate(1, _wrap_angle(score.heading))
    local[:, PELVIS] = yaw @ rotate(0, 0.35 * score.lean[:, 0]) @ rotate(2, 0.35 * score.lean[:, 1])
    shift = np.stack([score.shift[:, 0], np.zeros(frames), score.shift[:, 1]], -1)
    pelvis = np.einsum("fij,fj->fi", yaw, shift)
    pelvis[:, 1] += joints[PELVIS, 1] - ground - 0.015 + score.rise
    if score.travel is not None:
        pelvis[:, [0, 2]] += score.travel
    feet = score.feet or _step_on_the_spot(score)
    if score.feet is not None:
        pelvis[:, 1] -= _missing_reach(local, pelvis, feet, joints, ground)
    for joint in SPINES:
        bend = rotate(0, 0.22 * score.lean[:, 0]) @ rotate(2, 0.22 * score.lean[:, 1])
        local[:, joint] = bend @ rotate(1, score.twist / 3)
    # The head half undoes the trunk's bend and looks ahead of a turn.
    local[:, NECK] = rotate(0, -0.25 * score.lean[:, 0]) @ rotate(1, -0.3 * score.twist)
    local[:, HEAD] = rotate(0, -0.2 * score.lean[:, 0]) @ rotate(2, -0.4 * score.lean[:, 1])
    _pose_arms(local, score)
    for side, leg in enumerate(LEGS):
        _plant_leg(local, score.heading, feet, joints, ground, pelvis, side, leg)
    rotations = axis_angle_from_matrix(torch.from_numpy(local)).float()
    return Motion(rotations, torch.from_numpy(pelvis - joints[PELVIS]).float(), fps, name)


def _pose_arms(local: Float[ndarray, "f j 3 3"], score: Score) -> None:
    for side, (shoulder, elbow, wrist) in enumerate(ARMS):
        mirror = 1.0 if side == 0 else -1.0
        lower = rotate(2, mirror * (score.abduction[:, side] - np.pi / 2))
        local[:, shoulder] = rotate(0, -score.swing[:, side]) @ lower
        local[:, elbow] = rotate(1, -mirror * score.elbow[:, side])
        still = np.ones(len(local))
        local[:, wrist] = rotate(2, mirror * 0.08 * still)
        local[:, list(FINGERS[side])] = rotate(2, -mirror * 0.3 * still)[:, None]


def _step_on_the_spot(score: Score) -> Feet:
    """Return feet that stay under the centre, step as the heading turns, and leave the ground in jumps."""
    flight = np.maximum(score.rise, 0.0)
    place, yaws, pitches = [], [], []
    for mirror in (1.0, -1.0):
        yaw, lift = _step_foot(score.heading, mirror)
        ankle = np.einsum("fij,j->fi", rotate(1, _wrap_angle(yaw)), np.array([mirror * 0.105, 0.0, 0.0]))
        ankle[:, 1] = 0.06 * lift + flight
        place.append(ankle)
        yaws.append(yaw)
        pitches.append(np.clip(3.0 * flight + 0.35 * lift, 0.0, 0.7))
    return Feet(np.stack(place, 1), np.stack(yaws, -1), np.stack(pitches, -1))


def _missing_reach(
    local: Float[ndarray, "f j 3 3"],
    pelvis: Float[ndarray, "f 3"],
    feet: Feet,
    joints: Float[ndarray, "j 3"],
    ground: float,
) -> Curve:
    """Return how far the pelvis must come down for both legs to reach their feet, smooth in time; metres."""
    missing = np.zeros(len(pelvis))
    for side, (hip, knee, ankle) in enumerate(LEGS):
        offset = joints[hip] - joints[PELVIS]
        hip_world = pelvis + np.einsum("fij,j->fi", local[:, PELVIS], offset)
        length = np.linalg.norm(joints[knee] - joints[hip]) + np.linalg.norm(joints[ankle] - joints[knee])
        away = feet.place[:, side, [0, 2]] - hip_world[:, [0, 2]]
        height = np.sqrt(np.maximum((0.995 * length) ** 2 - np.sum(away**2, 1), 0.01))
        ankle_height = joints[ankle, 1] - ground + feet.place[:, side, 1]
        missing = np.maximum(missing, hip_world[:, 1] - height - ankle_height)
    # The largest of three frames, then their weighted mean: never less than what is missing by much.
    largest = np.lib.stride_tricks.sliding_window_view(np.pad(missing, 1, mode="edge"), 3).max(1)
    return np.convolve(np.pad(largest, 2, mode="edge"), np.array([1, 3, 4, 3, 1]) / 12, "valid")


def _plant_leg(
    local: Float[ndarray, "f j 3 3"],
    heading: Curve,
    feet: Feet,
    joints: Float[ndarray, "j 3"],
    ground: float,
    pelvis: Float[ndarray, "f 3"],
    side: int,
    leg: tuple[int, int, int],
) -> None:
    hip, knee, ankle = leg
    yaw = feet.yaw[:, side]
    foot = rotate(1, _wrap_angle(yaw))
    target = feet.place[:, side].copy()
    target[:, 1] += joints[ankle, 1] - ground
    knees_ahead = rotate(1, _wrap_angle(0.5 * (yaw + heading)))[:, :, 2]
    hip_world = pelvis + np.einsum("fij,j->fi", local[:, PELVIS], joints[hip] - joints[PELVIS])
    thigh, shin = joints[knee] - joints[hip], joints[ankle] - joints[knee]
    directions = _bend_leg(
        target - hip_world, float(np.linalg.norm(thigh)), float(np.linalg.norm(shin)), knees_ahead
    )
    world_thigh, world_shin = (
        _frame(direction, knees_ahead) @ _frame(rest[None], np.array([[0.0, 0.0, 1.0]]))[0].T
        for direction, rest in zip(directions, (thigh, shin), strict=True)
    )
    local[:, hip] = np.swapaxes(local[:, PELVIS], 1, 2) @ world_thigh
    local[:, knee] = np.swapaxes(world_thigh, 1, 2) @ world_shin
    local[:, ankle] = np.swapaxes(world_shin, 1, 2) @ foot @ rotate(0, feet.pitch[:, side])


def _step_foot(heading: Curve, mirror: float) -> tuple[Curve, Curve]:
    """Return a foot's yaw, a softened staircase under the heading, and how far it is lifted (0..1)."""
    x = heading / STEP + 0.5 - mirror * 0.25
    index = np.floor(x)
    # A foot travels during half of a step's turn, a quarter on either side of the tread's end.
    phase = x - index
    edge = np.where(phase > 0.5, phase - 1.0, phase)
    ramp = np.clip(edge / 0.5 + 0.5, 0.0, 1.0)
    tread = np.where(phase > 0.5, index, index - 1.0) + ramp * ramp * (3 - 2 * ramp)
    return STEP * tread + mirror * 0.14, np.sin(np.pi * ramp) ** 2


def _bend_leg(
    reach: Float[ndarray, "f 3"], thigh: float, shin: float, ahead: Float[ndarray, "f 3"]
) -> tuple[Float[ndarray, "f 3"], Float[ndarray, "f 3"]]:
    """Return unit directions of thigh and shin that reach from hip to ankle with the knee to the front."""
    distance = np.linalg.norm(reach, axis=1, keepdims=True)
    axis = reach / distance
    distance = np.minimum(distance, 0.9985 * (thigh + shin))
    front = ahead - axis * np.sum(ahead * axis, 1, keepdims=True)
    front /= np.linalg.norm(front, axis=1, keepdims=True)
    along = (thigh**2 - shin**2 + distance**2) / (2 * distance)
    aside = np.sqrt(np.maximum(thigh**2 - along**2, 0.0))
    upper = (along * axis + aside * front) / thigh
    lower = (distance * axis - upper * thigh) / shin
    return upper, lower / np.linalg.norm(lower, axis=1, keepdims=True)


def _frame(down: Float[ndarray, "f 3"], ahead: Float[ndarray, "f 3"]) -> Float[ndarray, "f 3 3"]:
    """Return rotations whose -Y column is `down` and whose Z column is nearest to `ahead`."""
    y = -down / np.linalg.norm(down, axis=-1, keepdims=True)
    x = np.cross(y, np.broadcast_to(ahead, y.shape))
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], -1)
