"""The temporal losses against the paper's equations, element by element, and against what they are for."""

import itertools

import numpy as np
import pytest
import torch

from dsar.config import LossConfig
from dsar.network import NetworkOutput
from dsar.training.temporal_losses import TemporalRecord, temporal_losses

ROTATION, SCALE, OPACITY_AND_COLOUR = range(0, 4), range(4, 7), range(7, 11)
"""Channels of the appearance residuals."""


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


def test_all_speeds_since_the_restart_count():
    still, moved = torch.zeros(1, 3, 2, 2), torch.full((1, 3, 2, 2), 0.01)
    after_its_first_frame = loss([record(still, speed=0.05), record(moved)], [1], prediction=1.0)
    assert after_its_first_frame == loss([record(still, speed=0.05), record(moved)], [5], prediction=1.0)
    assert after_its_first_frame < 0.1 * loss([record(still), record(moved)], [1], prediction=1.0)


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


def random_frames(frames: int) -> tuple[list[TemporalRecord], list[torch.Tensor]]:
    """Return records and motion magnitudes of three rollouts, 4 x 5 pixels and two levels of features."""
    generator = torch.Generator().manual_seed(5)

    def random(*shape: int, scale: float = 1.0) -> torch.Tensor:
        return scale * torch.randn(*shape, generator=generator)

    records = [
        TemporalRecord(
            NetworkOutput(
                random(3, 3, 4, 5, scale=0.02),
                random(3, 11, 4, 5, scale=0.3),
                (random(3, 2, 4, 5), random(3, 6, 2, 2)),
            ),
            random(3, 20, 3, scale=0.1),
        )
        for _ in range(frames)
    ]
    return records, [random(3, 1, 4, 5, scale=0.01).abs() for _ in range(frames)]


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_l_pred_is_equation_19_element_by_element(reduction):
    """w (|d mu|^2 + |d q|^2 + |d s|^2), offsets in cm; rotations and scales are weighed like offsets."""
    records, magnitudes = random_frames(2)
    occupied = (torch.arange(20).reshape(1, 1, 4, 5) % 3 > 0).float()
    config = LossConfig(
        feature=0.0,
        smoothness=0.0,
        prediction=0.7,
        temporal_scale=0.3,
        magnitude="frame",
        reduction=reduction,
    )
    expected = 0.0
    for b, y, x in itertools.product(range(3), range(4), range(5)):
        if b == 1:  # It has just begun: there is no frame before.
            continue
        metres_per_second = float(magnitudes[-1][b, 0, y, x]) * 30
        w = np.exp(-metres_per_second / config.tau) * float(occupied[0, 0, y, x])
        old, new = (
            np.concatenate(
                [100 * r.output.offset[b, :, y, x].numpy(), r.output.appearance[b, :, y, x].numpy()]
            )
            for r in records
        )
        change = (new.astype(np.float64) - old) ** 2
        mu, q, s = change[:3].sum(), change[3:7].sum(), change[7:10].sum()
        expected += w * (mu + q + s)
    expected *= 0.7 * 0.3 / 3 / (20 if reduction == "mean" else 1)
    losses = temporal_losses(records, magnitudes, [4, 0, 9], occupied, torch.arange(20), config)
    assert float(losses["prediction"]) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("channels", [ROTATION, SCALE, OPACITY_AND_COLOUR], ids=lambda c: str(list(c)))
def test_l_pred_holds_every_channel_of_rotation_and_scale_and_no_other(channels):
    for channel in channels:
        still, moved = record(torch.zeros(1, 3, 2, 2)), record(torch.zeros(1, 3, 2, 2))
        moved[0].output.appearance[:, channel] = 0.5
        counted = 0.25 if channel in (*ROTATION, *SCALE) else 0.0
        assert loss([still, moved], [5], prediction=1.0) == pytest.approx(counted), channel


def test_l_feat_is_equation_18_with_gamma_a_tenth_at_every_level():
    records, magnitudes = random_frames(2)
    config = LossConfig(prediction=0.0, smoothness=0.0, feature=0.8, temporal_scale=0.3)
    expected = 0.0
    for now, before in zip(records[1].output.features, records[0].output.features, strict=True):
        change = (now.double() - before.double()).numpy() ** 2
        # The rollout in the middle has just begun.
        expected += 0.1 * (change[0].mean() + change[2].mean()) / 3
    losses = temporal_losses(records, magnitudes, [4, 0, 9], torch.ones(1, 1, 4, 5), torch.arange(20), config)
    assert float(losses["feature"]) == pytest.approx(0.8 * 0.3 * expected, rel=1e-5)


def test_l_sm_is_equations_20_and_21_at_the_frame_in_the_middle():
    records, magnitudes = random_frames(3)
    config = LossConfig(prediction=0.0, feature=0.0, smoothness=0.6, temporal_scale=0.3, magnitude="frame")
    cells, occupied = torch.arange(20).flip(0), torch.ones(1, 1, 4, 5)
    oldest, middle, newest = (100 * record.posed.double().numpy() for record in records)
    w = np.exp(-magnitudes[1].double().numpy() * 30 / config.tau).reshape(3, 20)[:, ::-1]
    jolt = (w * ((newest - 2 * middle + oldest) ** 2).sum(-1)).mean(1)
    losses = temporal_losses(records, magnitudes, [4, 1, 9], occupied, cells, config)
    # The rollout in the middle has seen one frame before this one, not two.
    assert float(losses["smoothness"]) == pytest.approx(0.6 * 0.3 * (jolt[0] + jolt[2]) / 3, rel=1e-5)
