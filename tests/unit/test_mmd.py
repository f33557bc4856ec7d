"""Poses that are near, and poses that are far."""

import math

import pytest
import torch

from dsar.data.motions.mmd import median_distance, mmd, pose_features
from dsar.types import Motion


def test_mmd_of_two_gaussians_is_the_one_of_the_textbook():
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(4000, 1, generator=generator, dtype=torch.float64)
    y = torch.randn(4000, 1, generator=generator, dtype=torch.float64) + 1.0
    bandwidth = 0.8
    # A Gaussian kernel's mean over the difference of two normal samples, which is normal with variance 2.
    variance = bandwidth**2 + 2
    same = bandwidth / math.sqrt(variance)
    expected = math.sqrt(2 * same * (1 - math.exp(-0.5 / variance)))
    assert mmd(x, y, bandwidth) == pytest.approx(expected, abs=0.02)
    assert mmd(x[::2], x[1::2], bandwidth) < 0.05


def test_the_root_is_no_pose_and_a_bent_elbow_is():
    generator = torch.Generator().manual_seed(0)
    rotations = 0.1 * torch.randn(20, 55, 3, generator=generator)
    motion = Motion(rotations, torch.zeros(20, 3), 30.0)
    turned, bent = rotations.clone(), rotations.clone()
    turned[:, 0] += torch.tensor([0.0, 2.0, 0.0])
    bent[:, 18] += torch.tensor([0.0, 1.5, 0.0])
    known, same, other = (
        pose_features(Motion(r, torch.ones(20, 3), 30.0)) for r in (motion.rotations, turned, bent)
    )
    assert torch.equal(known, same)
    bandwidth = median_distance(known)
    assert mmd(known, same, bandwidth) == 0.0
    assert mmd(known, other, bandwidth) > 0.5
