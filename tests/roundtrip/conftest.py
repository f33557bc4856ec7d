import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

from dsar.geometry.cameras import look_at
from dsar.geometry.rotations import quaternion_from_axis_angle, quaternion_multiply
from dsar.types import Camera, Gaussians, GaussianSequence

FIRST_FRAME = 1001


@pytest.fixture
def make_gaussians() -> Callable[..., Gaussians]:
    def make(count: int, degree: int = 0) -> Gaussians:
        generator = torch.Generator().manual_seed(count + degree)
        return Gaussians(
            means=torch.randn(count, 3, generator=generator),
            rotations=torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1),
            scales=torch.rand(count, 3, generator=generator) * 0.05 + 0.001,
            opacities=torch.rand(count, generator=generator),
            harmonics=torch.randn(count, (degree + 1) ** 2, 3, generator=generator),
        )

    return make


@pytest.fixture
def make_sequence(make_gaussians: Callable[..., Gaussians]) -> Callable[..., GaussianSequence]:
    """Make Gaussians that swing and spin; their quaternions change sign at random."""

    def make(
        count: int = 5,
        degree: int = 0,
        frames: int = 4,
        step: int = 1,
        change: Callable[[int, Gaussians], Gaussians] = lambda _, gaussians: gaussians,
    ) -> GaussianSequence:
        rest = make_gaussians(count, degree)

        def produce() -> Iterator[Gaussians]:
            for index in range(frames):
                turn = quaternion_from_axis_angle(torch.tensor([0.0, 0.3 * index, 0.0]))
                rotations = quaternion_multiply(turn.expand(count, 4), rest.rotations) * (-1) ** index
                offset = torch.tensor([math.sin(index), 0.1 * index, 0.0])
                moved = Gaussians(rest.means + offset, rotations, rest.scales, rest.opacities, rest.harmonics)
                yield change(index, moved)

        numbers = range(FIRST_FRAME, FIRST_FRAME + frames * step, step)
        return GaussianSequence(numbers, 24.0, count, produce, {"motion": "swing"})

    return make


@pytest.fixture
def breaking_sequence(make_sequence: Callable[..., GaussianSequence]) -> GaussianSequence:
    """A sequence whose third frame fails."""

    def change(index: int, gaussians: Gaussians) -> Gaussians:
        if index == 2:
            raise RuntimeError("the network failed")
        return gaussians

    return make_sequence(change=change)


@pytest.fixture
def cameras() -> list[Camera]:
    """Two views with an off-centre principal point and oblong pixels, the second one tilted."""
    K = torch.tensor([[210.0, 0.0, 70.3], [0.0, 190.0, 41.7], [0.0, 0.0, 1.0]])
    spots = [np.array([0.5, 1.0, 4.0]), np.array([-3.0, 2.5, 3.0])]
    target = np.array([0.0, 1.0, 0.0])
    return [Camera(K, look_at(spot, target), 128, 96, f"cam{i:02d}") for i, spot in enumerate(spots)]
