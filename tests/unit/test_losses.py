"""Losses against independent implementations and their own definitions."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from dsar.config import LossConfig
from dsar.metrics.images import ssim
from dsar.network import NetworkOutput
from dsar.training.fused_loss import fused_image_loss
from dsar.training.losses import (
    TemporalRecord,
    plain_image_loss,
    pyramid_l1,
    registered_loss,
    spatial_loss,
    temporal_losses,
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


def record(offset, *, speed=0.0, posed=0.0, feature=0.0, cells=4):
    b = len(offset)
    output = NetworkOutput(offset, torch.zeros(b, 11, 2, 2), (torch.full((b, 3, 2, 2), feature),))
    return TemporalRecord(output, torch.full((b, cells, 3), posed)), torch.full((b, 1, 2, 2), speed)


def loss(records, ages, **weights):
    config = LossConfig(
        **({"feature": 0.0, "prediction": 0.0, "smoothness": 0.0, "temporal_scale": 1.0} | weights)
    )
    records, speeds = zip(*records, strict=True)
    terms = temporal_losses(records, speeds, ages, torch.ones(1, 1, 2, 2), torch.arange(4), config)
    return float(sum(terms.values()))


def test_spatial_loss_counts_a_centimetre_between_neighbours_as_one():
    offsets, edges = torch.full((2, 3, 3), 0.2), torch.tensor([[0, 1], [1, 2]])
    assert spatial_loss(offsets, edges) == 0
    offsets[0, 0, 1] += 0.01
    # One link of two, in one rollout of two.
    assert abs(float(spatial_loss(offsets, edges)) - 0.25) < 1e-5
    assert spatial_loss(offsets, edges[:0]) == 0


def test_prediction_loss_counts_a_centimetre_as_one():
    still, moved = torch.zeros(1, 3, 2, 2), torch.zeros(1, 3, 2, 2)
    moved[:, 0] = 0.01
    assert abs(loss([record(still), record(moved)], [5], prediction=1.0) - 1.0) < 1e-6


def test_a_fresh_rollout_is_not_compared_with_the_one_before_it():
    still, moved = torch.zeros(2, 3, 2, 2), torch.ones(2, 3, 2, 2)
    both = loss([record(still), record(moved)], [5, 5], prediction=1.0)
    one = loss([record(still), record(moved)], [0, 5], prediction=1.0)
    assert abs(one - both / 2) < 1e-3


def test_smoothness_is_zero_for_steady_motion_and_needs_three_frames():
    zero = torch.zeros(1, 3, 2, 2)
    steady = [record(zero, posed=p) for p in (0.0, 0.1, 0.2)]
    jolt = [record(zero, posed=p) for p in (0.0, 0.1, 0.1)]
    assert loss(steady, [5], smoothness=1.0) < 1e-8
    assert abs(loss(jolt, [5], smoothness=1.0) - 3 * 10.0**2) < 1e-2
    assert loss(jolt, [1], smoothness=1.0) == 0


def test_motion_anywhere_in_the_record_loosens_the_weight():
    still, moved = torch.zeros(1, 3, 2, 2), torch.full((1, 3, 2, 2), 0.01)
    rest = loss([record(still), record(moved)], [5], prediction=1.0)
    after_a_stop = loss([record(still, speed=0.01), record(moved)], [5], prediction=1.0)
    # 0.01 m a frame at 30 fps is 0.3 m/s: the weight's 1/e point.
    assert abs(after_a_stop / rest - np.exp(-1)) < 1e-5
    paper = loss([record(still, speed=0.01), record(moved)], [5], prediction=1.0, magnitude="frame")
    assert paper == rest


def test_speeds_from_before_a_restart_do_not_count():
    still, moved = torch.zeros(1, 3, 2, 2), torch.full((1, 3, 2, 2), 0.01)
    records = [record(still, speed=0.05), record(still), record(moved)]
    old, young = (loss(records, [age], prediction=1.0) for age in (5, 1))
    assert young == loss([record(still), record(still), record(moved)], [5], prediction=1.0)
    assert old < 0.1 * young


def test_an_acceleration_is_weighed_by_the_speed_of_the_frame_in_the_middle():
    still = torch.zeros(1, 3, 2, 2)
    for place in range(3):
        speeds = [0.01 if place == k else 0.0 for k in range(3)]
        records = [record(still, posed=p, speed=v) for p, v in zip((0.0, 0.1, 0.1), speeds, strict=True)]
        found = loss(records, [5], smoothness=1.0, magnitude="frame") / 300.0
        assert abs(found - (np.exp(-1) if place == 1 else 1.0)) < 1e-4


def test_without_adaptation_motion_does_not_matter():
    still, moved = torch.zeros(1, 3, 2, 2), torch.full((1, 3, 2, 2), 0.01)
    fast = [record(still, speed=0.5), record(moved, speed=0.5)]
    assert abs(loss(fast, [5], prediction=1.0, adaptive=False) - 3.0) < 1e-5
    assert loss(fast, [5], prediction=1.0) < 1e-5


def test_sums_are_means_times_the_number_of_elements():
    still, moved = torch.zeros(2, 3, 2, 2), torch.full((2, 3, 2, 2), 0.01)
    records = [record(still), record(moved, feature=0.1, posed=0.02), record(still, posed=0.5)]
    for name, count in (("prediction", 4), ("feature", 3 * 4), ("smoothness", 4)):
        mean, total = (loss(records, [5, 5], **{name: 1.0}, reduction=how) for how in ("mean", "sum"))
        assert abs(total - count * mean) < 1e-4 * total, name


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
