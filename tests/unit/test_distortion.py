"""Undistorted images are what a pinhole camera would have seen."""

import numpy as np
import pytest
import torch

from dsar.data.images.distortion import parse_distortion, undistort
from dsar.errors import CaptureError
from dsar.types import Camera

WIDTH, HEIGHT = 90, 70
LENS = (-0.28, 0.09, 0.004, -0.006, 0.02)


@pytest.fixture
def camera():
    K = torch.tensor([[80.0, 0.0, 43.7], [0.0, 82.0, 36.1], [0.0, 0.0, 1.0]])
    return Camera(K, torch.eye(4), WIDTH, HEIGHT, "cam")


def scene(u, v):
    """A smooth picture as a function of pinhole pixel coordinates (pixel 0's centre is 0.5)."""
    waves = np.stack([np.sin(u / 9) * np.cos(v / 11), np.sin(v / 7), np.cos((u + v) / 13)], -1)
    return 127.5 + 120 * waves


def bend(x, y):
    """Where a lens puts a pinhole direction: OpenCV's documentation, written anew in complex numbers."""
    k1, k2, p1, p2, k3 = LENS
    z, r = x + 1j * y, x * x + y * y
    tangential = (2 * p1 * x * y + p2 * (r + 2 * x * x)) + 1j * (p1 * (r + 2 * y * y) + 2 * p2 * x * y)
    return z * (1 + k1 * r + k2 * r**2 + k3 * r**3) + tangential


def test_a_scene_seen_through_a_lens_is_straightened(camera):
    K = camera.K.double().numpy()
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    # The photograph: each of its pixels shows the direction that the lens bends to it, found by iteration.
    straight = x + 1j * y
    for _ in range(60):
        straight = straight + (x + 1j * y) - bend(straight.real, straight.imag)
    photograph = scene(straight.real * K[0, 0] + K[0, 2], straight.imag * K[1, 1] + K[1, 2])
    found = undistort(photograph.round().astype(np.uint8), camera, LENS).astype(float)
    truth = scene(columns, rows)
    inner = np.s_[8:-8, 8:-8]
    assert np.abs(photograph - truth)[inner].mean() > 4
    assert np.abs(found - truth)[inner].max() < 3


def test_no_distortion_leaves_the_image_alone(camera):
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)
    assert undistort(image, camera, (0.0,) * 5) is image
    # Far too little to move a pixel's value, through the same code.
    assert np.array_equal(undistort(image, camera, (1e-12, 0.0, 0.0, 0.0, 0.0)), image)


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [((), (0,) * 5), ([[0.1, 0.2]], (0.1, 0.2, 0, 0, 0)), ([0.1] * 5 + [0.0] * 3, (0.1,) * 5)],
)
def test_coefficients_are_completed(numbers, expected):
    assert parse_distortion("cam", numbers) == expected


@pytest.mark.parametrize("numbers", [[0.1] * 6, ["a"], [float("inf")], [None]])
def test_other_models_are_refused(numbers):
    with pytest.raises(CaptureError, match=r"cam: .*distCoeff"):
        parse_distortion("cam", numbers)
