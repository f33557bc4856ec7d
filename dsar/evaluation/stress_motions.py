"""Motions made to find out where a rollout fails; each starts from a pose that the capture has."""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.data.motions.files import rotate_motion
from dsar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from dsar.types import Body, Motion


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
