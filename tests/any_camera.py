"""Cameras of every kind."""

import math

import numpy as np
import torch

from dsar.geometry.cameras import look_at
from dsar.types import Camera


def random_camera(seed: int) -> Camera:
    """Return a camera somewhere, rolled, with a lens of its own."""
    random = np.random.default_rng(seed)
    width, height = (int(side) for side in random.integers(64, 160, 2))
    fx = width / (2 * math.tan(math.radians(random.uniform(12, 40))))
    K = torch.tensor(
        [
            [fx, 0.0, width * random.uniform(0.3, 0.7)],
            [0.0, fx * random.uniform(0.8, 1.25), height * random.uniform(0.3, 0.7)],
            [0.0, 0.0, 1.0],
        ]
    ).float()
    T = look_at(random.normal(size=3) * 3, random.normal(size=3))
    angle = random.uniform(-math.pi, math.pi)
    roll = torch.eye(4)
    roll[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return Camera(K, roll @ T, width, height, f"cam{seed}")
