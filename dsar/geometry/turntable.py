"""A camera that circles a moving person."""

import math
from collections.abc import Sequence

import numpy as np
import torch

from dsar.geometry.cameras import look_at
from dsar.types import Binding, Camera

TURNTABLE = "turntable"
"""Its name beside those of a capture's cameras."""
PERIOD_S = 8.0
"""Seconds of one turn."""
_START_FRAME = 1001
_DISTANCE = 2.6
"""Its distance from the person, in heights of the person."""
_ELEVATION = math.radians(8)
_MARGIN = 1.35
"""Height of the picture in heights of the person: room for arms and jumps."""


def turntable(
    binding: Binding, frame_numbers: Sequence[int], fps: float, *, width: int, height: int
) -> list[Camera]:
    """Return the camera of each frame.

    It looks at the middle of the body, goes where the pelvis goes, and starts in front (+Z) at frame 1001; a
    frame's camera does not depend on which other frames are asked for.

    Args:
        binding: The body and its joints by frame.
        frame_numbers: As many as the binding has frames.
        fps: Frames per second.
        width: Pixels.
        height: Pixels.
    """
    rest = binding.body.vertices
    lowest, highest = float(rest[:, 1].min()), float(rest[:, 1].max())
    tall = highest - lowest
    pelvis = binding.body.joints[0]
    turns, shifts = binding.T_world_rest[:, 0, :3, :3], binding.T_world_rest[:, 0, :3, 3]
    places = (turns @ pelvis + shifts).double().numpy()
    middle = np.array([0.0, (lowest + highest) / 2 - float(pelvis[1]), 0.0])
    focal = height * _DISTANCE / _MARGIN
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    cameras = []
    for place, frame in zip(places, frame_numbers, strict=True):
        angle = 2 * math.pi * (frame - _START_FRAME) / (fps * PERIOD_S)
        level = math.cos(_ELEVATION)
        direction = np.array([math.sin(angle) * level, math.sin(_ELEVATION), math.cos(angle) * level])
        target = place + middle
        view = look_at(target + _DISTANCE * tall * direction, target)
        cameras.append(Camera(K, view, width, height, TURNTABLE))
    return cameras
