"""Settling and looped motions, on motions whose answers are known."""

import torch

from dsar.evaluation.looping import loop_motion
from dsar.evaluation.settling import rms_speeds, settling_time
from dsar.geometry.rotations import matrix_from_axis_angle
from dsar.types import Motion


def test_a_damped_swing_settles_when_its_envelope_is_low():
    t = torch.arange(300) / 100
    x = torch.exp(-2 * t) * torch.sin(2 * torch.pi * 2 * t)
    points = torch.zeros(300, 5, 3)
    points[:, :, 1] = x[:, None]
    speeds = rms_speeds(points, 100.0)
    # Speed is at most 4 pi exp(-2 t), reached twice a swing: below a fifth of that from ln(5) / 2 = .80 s on.
    settled = settling_time(speeds, 0, 299, 0.2 * 4 * torch.pi, 100.0)
    assert 0.80 - 0.25 < settled <= 0.81
    assert settling_time(speeds, 0, 50, 0.2 * 4 * torch.pi, 100.0) == 0.5, "not settled within the stretch"
    assert settling_time(torch.zeros(20), 0, 20, 0.1, 100.0) == 0


def test_speed_is_in_metres_a_second():
    points = torch.zeros(3, 2, 3)
    points[1:, 0, 2] = 0.1
    assert torch.allclose(rms_speeds(points, 30.0), torch.tensor([3.0 / 2**0.5, 0.0]))


def test_rounds_are_equal_and_joined_without_a_jump():
    generator = torch.Generator().manual_seed(0)
    rotations = (0.1 * torch.randn(20, 55, 3, generator=generator)).cumsum(0) * 0.3
    motion = Motion(rotations, rotations[:, 0].clone(), 30.0, "walk")
    long, period = loop_motion(motion, 3, bridge=0.5)
    assert len(long) == 3 * period
    assert torch.equal(long.rotations[:20], motion.rotations)
    assert torch.equal(long.rotations[:period], long.rotations[period : 2 * period])
    largest = (motion.rotations[-1] - motion.rotations[0]).norm(dim=-1).max()
    turns = matrix_from_axis_angle(long.rotations[19 : period + 1])
    steps = (turns[1:] - turns[:-1]).flatten(2).norm(dim=-1).max()
    assert steps < 2 * largest / 15
    moved = long.translations[19 : period + 1].diff(dim=0).norm(dim=-1).max()
    assert moved < 2 * (motion.translations[-1] - motion.translations[0]).norm() / 15
    assert torch.equal(long.rotations[period - 15 : period], motion.rotations[:1].expand(15, -1, -1))
