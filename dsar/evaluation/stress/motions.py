"""Motions made to find out where a rollout fails; each starts from a pose that the capture has."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.body.model import JOINT_NAMES
from dsar.body.skinning import blend_transforms, forward_kinematics
from dsar.data.motions.files import resample, rotate_motion
from dsar.geometry.rotations import axis_angle_from_matrix, heading_matrix, matrix_from_axis_angle
from dsar.types import Body, Motion

_BODY_JOINTS = 22
"""Joints without face and fingers, the root first."""
_MOST_TURN = math.radians(150)
"""Radians that a joint turns in a gap at most."""
_WANDERING = (0.5, 0.7, 1.1)
"""Swings a second along the main components of poses."""


def rotate_in_place(motion: Motion, yaw: Float[Tensor, " f"]) -> Motion:
    """Return the motion's first pose, turned in place about the vertical by `yaw` radians at each frame."""
    turns = matrix_from_axis_angle(torch.stack([torch.zeros_like(yaw), yaw, torch.zeros_like(yaw)], -1))
    roots = axis_angle_from_matrix(turns @ matrix_from_axis_angle(motion.rotations[0, 0]))
    rotations = motion.rotations[:1].repeat(len(yaw), 1, 1)
    rotations[:, 0] = roots
    return dataclasses.replace(
        motion, rotations=rotations, translations=motion.translations[:1].expand(len(yaw), -1)
    )


def sway_motion(motion: Motion, cycles: int, seconds: float = 2.0, angle: float = 1.0) -> tuple[Motion, int]:
    """Return a pose that turns to and fro by `angle` radians, and the frames of a cycle."""
    period = round(seconds * motion.fps)
    phase = torch.arange(cycles * period) * (2 * math.pi / period)
    # From rest: the first half cycle swells.
    return rotate_in_place(motion, angle * phase.sin() * (phase / math.pi).clamp(max=1)), period


def spin_and_stop(
    motion: Motion, speed: float = 5.0, spin: float = 2.0, rest: float = 5.0
) -> tuple[Motion, int]:
    """Return a pose that turns at `speed` radians a second and stops at once, and the spin's last frame.

    It takes half a second to get up to speed, and stands for `rest` seconds.
    """
    frames = round(spin * motion.fps)
    times = torch.arange(frames + 1) / motion.fps
    speeds = speed * (times / 0.5).clamp(max=1)
    yaw = torch.cumsum(speeds, 0) / motion.fps
    still = yaw[-1:].expand(round(rest * motion.fps))
    return rotate_in_place(motion, torch.cat([yaw, still])), frames


def teleport_motion(motion: Motion, body: Body, frame: int, distance: float = 10.0) -> Motion:
    """Return a motion that from a frame on goes on elsewhere, facing the other way."""
    about = rotate_motion(motion, body, matrix_from_axis_angle(torch.tensor([0.0, math.pi, 0.0])))
    moved = about.translations + torch.tensor([distance, 0.0, 0.0])
    return dataclasses.replace(
        motion,
        rotations=torch.cat([motion.rotations[:frame], about.rotations[frame:]]),
        translations=torch.cat([motion.translations[:frame], moved[frame:]]),
    )


def change_future(motion: Motion, frame: int) -> Motion:
    """Return a motion that from a frame on bends otherwise."""
    rotations = motion.rotations.clone()
    rotations[frame:, 1:] += 0.3
    return dataclasses.replace(motion, rotations=rotations)


def fastest_gap(motion: Motion, count: int) -> int:
    """Return where `count` frames can be missing while the body is fastest.

    In the gap no joint turns by more than `_MOST_TURN`: beyond half a turn none could fill it.
    """
    first = matrix_from_axis_angle(motion.rotations[: max(1, len(motion) - count - 1), :_BODY_JOINTS])
    last = matrix_from_axis_angle(motion.rotations[count + 1 :, :_BODY_JOINTS])
    if not len(last):
        return 1
    turns = axis_angle_from_matrix(first.mT @ last).norm(dim=-1)
    # Turns of more than half a turn look like less: frame by frame they do not.
    steps = matrix_from_axis_angle(motion.rotations[:, :_BODY_JOINTS])
    speeds = axis_angle_from_matrix(steps[:-1].mT @ steps[1:]).norm(dim=-1)
    ways = speeds.unfold(0, count + 1, 1).sum(-1)
    fits = (ways.amax(1) < _MOST_TURN) & (turns.amax(1) < _MOST_TURN)
    return 1 + int(torch.where(fits, ways.mean(1), -1.0).argmax())


def fill_gap(motion: Motion, start: int, count: int) -> Motion:
    """Return a motion of which `count` frames from `start` on are lost, and filled in between.

    Rotations go from the last frame before to the first after at constant speed, as a reader of files does.
    """
    end = min(start + count, len(motion) - 1)
    ends = torch.tensor([max(start - 1, 0), end])
    span = max(1, int(ends[1] - ends[0]))
    pair = dataclasses.replace(
        motion,
        rotations=motion.rotations[ends],
        translations=motion.translations[ends],
        fps=motion.fps / span,
    )
    way = resample(pair, motion.fps)
    rotations, translations = motion.rotations.clone(), motion.translations.clone()
    rotations[ends[0] + 1 : end] = way.rotations[1:span]
    translations[ends[0] + 1 : end] = way.translations[1:span]
    return dataclasses.replace(motion, rotations=rotations, translations=translations)


def shake_joints(motion: Motion, degrees: float, generator: torch.Generator) -> Motion:
    """Return a motion whose body joints are each turned by noise of its own in each frame.

    Args:
        motion: Any.
        degrees: Standard deviation of the turn about each axis.
        generator: Of the noise.
    """
    noise = torch.randn(len(motion), _BODY_JOINTS, 3, generator=generator) * math.radians(degrees)
    body = matrix_from_axis_angle(motion.rotations[:, :_BODY_JOINTS]) @ matrix_from_axis_angle(noise)
    rotations = torch.cat([axis_angle_from_matrix(body), motion.rotations[:, _BODY_JOINTS:]], 1)
    return dataclasses.replace(motion, rotations=rotations)


def wander_poses(motion: Motion, sigmas: float, seconds: float = 4.0) -> Motion:
    """Return a motion in place whose pose wanders along the three main components of a motion's poses.

    It swings to `sigmas` standard deviations along each, in periods that do not divide each other, and begins
    and ends at the mean.
    """
    poses = motion.rotations[:, 1:_BODY_JOINTS].flatten(1)
    mean = poses.mean(0)
    _, spread, axes = torch.linalg.svd(poses - mean, full_matrices=False)
    times = torch.arange(round(seconds * motion.fps)) / motion.fps
    swell = (times * (seconds - times)).clamp(0, 1)
    walk = mean.expand(len(times), -1).clone()
    for rate, deviation, axis in zip(_WANDERING, spread / len(poses) ** 0.5, axes, strict=False):
        walk += sigmas * deviation * (swell * (2 * math.pi * rate * times).sin())[:, None] * axis
    rotations = motion.rotations[:1].repeat(len(times), 1, 1)
    rotations[:, 1:_BODY_JOINTS] = walk.unflatten(1, (-1, 3))
    translations = motion.translations[:1].expand(len(times), -1)
    return dataclasses.replace(motion, rotations=rotations, translations=translations)


def scale_motion(motion: Motion, body: Body, factor: float) -> Motion:
    """Return a motion as it was captured on a person `factor` times as large: steps, hips and jumps scale."""
    pelvis = body.joints[0].to(motion.translations)
    return dataclasses.replace(motion, translations=(motion.translations + pelvis) * factor - pelvis)


@dataclass(frozen=True)
class Key:
    """A pose on the way of a made motion."""

    seconds: float
    """Time that the body takes to get there."""
    joints: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """Axis-angles, degrees, of joints; all others are as at the start. X bends forward, Y turns, Z opens."""
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Axis-angle, degrees, by which the whole body is turned from where it was at the key before, in axes of
    its first frame: X to its left, Y up, Z ahead."""
    hold: float = 0.0
    """Seconds that it stays."""
    lift: float = 0.0
    """Metres that the lowest point is above the ground."""


def play_keys(motion: Motion, body: Body, keys: Sequence[Key], name: str) -> Motion:
    """Return a motion from a motion's first pose through others, eased in and out of each.

    The body's lowest point is on the ground, at y = 0, or as high above as the keys say.
    """
    pose, root, lift = motion.rotations[0].clone(), motion.rotations[0, 0], 0.0
    heading = heading_matrix(matrix_from_axis_angle(root))
    rotations, lifts = [pose[None]], [torch.zeros(1)]
    for key in keys:
        goal = motion.rotations[0].clone()
        for joint, degrees in key.joints.items():
            goal[JOINT_NAMES.index(joint)] = torch.tensor(degrees) * (math.pi / 180)
        steps = max(1, round(key.seconds * motion.fps))
        part = torch.arange(1, steps + 1) / steps
        part = part * part * (3 - 2 * part)
        way = _between(pose, goal, part)
        turn = heading @ (torch.tensor(key.turn) * (math.pi / 180))
        turned = matrix_from_axis_angle(part[:, None] * turn) @ matrix_from_axis_angle(root)
        way[:, 0] = axis_angle_from_matrix(turned)
        pose, root = way[-1].clone(), way[-1, 0]
        held = round(key.hold * motion.fps)
        rotations += [way, way[-1:].repeat(held, 1, 1)]
        lifts += [lift + part * (key.lift - lift), torch.full((held,), key.lift)]
        lift = key.lift
    every = torch.cat(rotations)
    still = motion.translations[:1].repeat(len(every), 1)
    still[:, 1] += torch.cat(lifts) - _lowest(body, every, still)
    return dataclasses.replace(motion, rotations=every, translations=still, name=name)


def _between(
    start: Float[Tensor, "j 3"], end: Float[Tensor, "j 3"], part: Float[Tensor, " s"]
) -> Float[Tensor, "s j 3"]:
    """Return poses between two, joint by joint the shortest way."""
    first, last = matrix_from_axis_angle(start), matrix_from_axis_angle(end)
    change = axis_angle_from_matrix(first.mT @ last)
    return axis_angle_from_matrix(first @ matrix_from_axis_angle(part[:, None, None] * change))


def _lowest(
    body: Body, rotations: Float[Tensor, "f j 3"], translations: Float[Tensor, "f 3"]
) -> Float[Tensor, " f"]:
    """Return the height of the lowest of some points of the body in each frame."""
    few = slice(None, None, 20)
    blended = blend_transforms(body.weights[few], forward_kinematics(body, rotations, translations))
    points = (blended[..., :3] * body.vertices[few, None]).sum(-1) + blended[..., 3]
    return points[..., 1].amin(1)
