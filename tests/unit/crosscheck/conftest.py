"""Mitsuba in the variants that this machine has, and cameras of every kind."""

import numpy as np
import pytest
import torch

from dsar.geometry.cameras import look_at
from dsar.types import Camera, Gaussians
from dsar_render.crosscheck.backend import LLVM, SCALAR, find_llvm, load_mitsuba


@pytest.fixture
def scalar():
    pytest.importorskip("mitsuba")
    return load_mitsuba(SCALAR)


@pytest.fixture
def llvm():
    pytest.importorskip("mitsuba")
    if find_llvm() is None:
        pytest.skip("no LLVM that Mitsuba works with: install libllvm19")
    return load_mitsuba(LLVM)


@pytest.fixture
def oblong() -> Camera:
    """A camera with an off-centre principal point and oblong pixels."""
    K = torch.tensor([[150.0, 0.0, 60.3], [0.0, 172.0, 52.1], [0.0, 0.0, 1.0]])
    return Camera(K, look_at(np.array([0.4, 0.5, 2.4]), np.array([0.0, 0.1, 0.0])), 128, 96, "oblong")


@pytest.fixture
def cloud() -> Gaussians:
    """Coloured Gaussians that overlap, before the camera `oblong`."""
    random = torch.Generator().manual_seed(3)
    count = 120
    return Gaussians(
        means=(torch.rand(count, 3, generator=random) - 0.5) * torch.tensor([1.0, 0.8, 0.6]),
        rotations=torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=-1),
        scales=0.03 + 0.05 * torch.rand(count, 3, generator=random),
        opacities=0.2 + 0.7 * torch.rand(count, generator=random),
        harmonics=0.6
        * torch.randn(count, 4, 3, generator=random)
        * torch.tensor([1.0, 0.3, 0.3, 0.3])[:, None],
    )
