"""Losses against independent implementations and their own definitions."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from dsar.metrics.images import ssim
from dsar.training.fused_loss import fused_image_loss
from dsar.training.losses import (
    plain_image_loss,
    pyramid_l1,
    registered_loss,
    spatial_loss,
)


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


def test_pyramid_sees_a_shift_that_plain_l1_cannot_order():
    stripes = (torch.arange(64) // 4 % 2).float()[None, :, None].expand(64, 64, 3)
    near = torch.roll(stripes, 1, 1)
    blank = torch.full_like(stripes, 0.5)
    assert pyramid_l1(stripes, stripes, 4) == 0
    assert pyramid_l1(near, stripes, 1) == (near - stripes).abs().mean()
    far = torch.roll(stripes, 4, 1)
    assert pyramid_l1(far, stripes, 1) > pyramid_l1(near, stripes, 1)
    assert pyramid_l1(blank, stripes, 4) < pyramid_l1(blank, stripes, 1)


def test_spatial_loss_counts_a_centimetre_between_neighbours_as_one():
    offsets, edges = torch.full((2, 3, 3), 0.2), torch.tensor([[0, 1], [1, 2]])
    assert spatial_loss(offsets, edges) == 0
    offsets[0, 0, 1] += 0.01
    # One link of two, in one rollout of two.
    assert abs(float(spatial_loss(offsets, edges)) - 0.25) < 1e-5
    assert spatial_loss(offsets, edges[:0]) == 0


@pytest.mark.parametrize("size", [(37, 22), (64, 48), (7, 5)])
@pytest.mark.parametrize("weights", [(1.0, 0.1, 0.3), (0.5, 0.0, 0.0), (0.0, 1.0, 0.0)])
def test_fused_losses_equal_the_plain_ones_in_value_and_gradient(size, weights):
    generator = torch.Generator().manual_seed(3)
    truth, mask = torch.rand(*size, 3, generator=generator), torch.rand(*size, generator=generator)
    color = (truth + 0.3 * torch.randn(*size, 3, generator=generator)).requires_grad_()
    alpha = torch.rand(*size, generator=generator).requires_grad_()
    results = []
    for compare in (plain_image_loss, fused_image_loss):
        loss = compare(color, alpha, truth, mask, 4, weights)
        results.append([loss, *torch.autograd.grad(3 * loss, (color, alpha))])
    for plain, fused in zip(*results, strict=True):
        assert torch.allclose(plain, fused, rtol=1e-4, atol=1e-6 * float(plain.detach().abs().max()) + 1e-9)


def test_distance_to_registered_maps_is_in_centimetres():
    registered, offsets = torch.zeros(2, 2, 3), torch.zeros(2, 2, 3)
    offsets[1, 0] = torch.tensor([0.3, 0.0, 0.4])
    loss = registered_loss(offsets, registered)
    assert loss[0] == 0
    # One of two points is half a metre off; the knee of half a centimetre hardly shows.
    assert abs(loss[1] - 25.0) < 0.3
