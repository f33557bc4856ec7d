"""Losses against independent implementations and their own definitions."""

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from dsar.metrics.images import ssim
from dsar.training.losses import registered_loss, spatial_loss


def images(seed=0, size=(40, 33)):
    generator = torch.Generator().manual_seed(seed)
    a = torch.rand(*size, 3, generator=generator)
    return a, (a + 0.2 * torch.randn(*size, 3, generator=generator)).clamp(0, 1)


def test_ssim_equals_its_published_definition():
    a, b = images()

    def blur(x):
        # truncate 5 / 1.5 gives the 11-pixel window; constant mode is zero padding.
        return gaussian_filter(x, (1.5, 1.5, 0), truncate=5 / 1.5, mode="constant")

    x, y = a.double().numpy(), b.double().numpy()
    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    expected = np.mean((2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2)))
    assert abs(float(ssim(a, b)) - expected) < 1e-5
    assert abs(float(ssim(a, a)) - 1) < 1e-6


def test_spatial_loss_counts_a_centimetre_between_neighbours_as_one():
    offsets, edges = torch.full((2, 3, 3), 0.2), torch.tensor([[0, 1], [1, 2]])
    assert spatial_loss(offsets, edges) == 0
    offsets[0, 0, 1] += 0.01
    # One link of two, in one rollout of two.
    assert abs(float(spatial_loss(offsets, edges)) - 0.25) < 1e-5
    assert spatial_loss(offsets, edges[:0]) == 0


def test_distance_to_registered_maps_is_in_centimetres():
    registered, offsets = torch.zeros(2, 2, 3), torch.zeros(2, 2, 3)
    offsets[1, 0] = torch.tensor([0.3, 0.0, 0.4])
    loss = registered_loss(offsets, registered)
    assert loss[0] == 0
    # One of two points is half a metre off; the knee of half a centimetre hardly shows.
    assert abs(loss[1] - 25.0) < 0.3
