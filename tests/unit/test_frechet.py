"""Fréchet distances: known ones of known Gaussians, and films that differ in time alone."""

import numpy as np
import pytest
import torch

from dsar.errors import ConfigError
from dsar.evaluation.frechet import frechet_distance, i3d_features, load_i3d, slice_features
from dsar.metrics.lpips import Lpips


def film(frames: int = 32, speed: int = 2) -> np.ndarray:
    picture = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8).repeat(4, 0).repeat(4, 1)
    return np.stack([np.roll(picture, speed * frame, 1) for frame in range(frames)])


def test_distance_of_gaussians_is_the_closed_form():
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(400, 5, generator=generator).double()
    assert frechet_distance(x, x) == pytest.approx(0, abs=1e-6)
    # Moved by 3 along one axis: 9. Twice as wide: the sum of variances.
    assert frechet_distance(x + torch.tensor([3.0, 0, 0, 0, 0]), x) == pytest.approx(9, rel=1e-6)
    assert frechet_distance(2 * x, x) == pytest.approx(
        float(x.mean(0).square().sum() + torch.cov(x.T).trace()), rel=1e-6
    )
    # Covariances that do not commute, by a root that is computed otherwise.
    y = x @ torch.randn(5, 5, generator=generator).double()
    c, d = torch.cov(x.T), torch.cov(y.T)
    values, vectors = torch.linalg.eigh(c)
    root = vectors * values.sqrt() @ vectors.T
    cross = torch.linalg.eigvalsh(root @ d @ root).clamp_min(0).sqrt().sum()
    expected = (x.mean(0) - y.mean(0)).square().sum() + c.trace() + d.trace() - 2 * cross
    assert frechet_distance(x, y) == pytest.approx(float(expected), rel=1e-6)
    assert frechet_distance(x, y) == pytest.approx(frechet_distance(y, x), rel=1e-6)


def test_slices_see_motion_and_flicker_that_single_frames_do_not_show():
    torch.manual_seed(0)
    network, moving = Lpips("alex"), film()
    true = slice_features(moving, network)
    assert true.shape == (3, 512)
    for other in (moving[np.zeros(len(moving), int)], np.random.default_rng(1).permutation(moving)):
        assert frechet_distance(slice_features(other, network), true) > 1e-4


class Shape(torch.nn.Module):
    """Stands for I3D: says what it was given."""

    def forward(self, x, rescale: bool, resize: bool, return_features: bool):
        return torch.stack([x.mean(), x.amin(), x.amax(), torch.tensor(float(x.numel()))])[None]


def test_a_users_i3d_is_given_clips_as_it_expects_them(tmp_path, monkeypatch):
    found = i3d_features(film(), Shape())
    assert found.shape == (3, 4)
    assert (found[:, 3] == 3 * 16 * 224 * 224).all()
    assert (found[:, 1] >= -1).all()
    assert (found[:, 2] <= 1).all()
    assert (found[:, 1] < -0.5).all()
    monkeypatch.setenv("DSAR_I3D", str(tmp_path / "none.pt"))
    with pytest.raises(ConfigError, match=r"none\.pt"):
        load_i3d()
    (tmp_path / "none.pt").write_bytes(b"no network")
    with pytest.raises(ConfigError, match=r"none\.pt; expected I3D as TorchScript, found"):
        load_i3d()
