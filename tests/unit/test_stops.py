"""Stops of a body, and what garments of known swing do after them."""

import math

import pytest
import torch

from dsar.body.files import load_body
from dsar.body.skinning import forward_kinematics
from dsar.evaluation.stops import find_stops, measure_stop
from dsar.evaluation.stress.motions import spin_and_stop, sway_motion
from tests.loose_cloth import FPS, striding


def stops_of(motion):
    body = load_body()
    return find_stops(body, forward_kinematics(body, motion.rotations, motion.translations), motion.fps)


def test_a_stop_is_where_a_body_stands_after_it_has_moved():
    walk = striding(40, 0, "walk")
    spin, stop = spin_and_stop(walk, rest=2.0)
    assert stops_of(spin) == [range(stop, len(spin))]
    assert stops_of(sway_motion(walk, 3)[0]) == []
    assert stops_of(spin.slice(0, stop + round(0.8 * FPS))) == [], "too short to see anything settle"
    assert stops_of(spin.slice(stop + round(1.1 * FPS), len(spin))) == [], "it has not moved"
    # It goes on after the pose that is held: the stretch ends with the last frame of it.
    frames = torch.cat([torch.arange(len(spin)), torch.arange(len(spin) - 1, 0, -1)])
    to_and_fro = type(spin)(spin.rotations[frames], spin.translations[frames], FPS, "to and fro")
    assert stops_of(to_and_fro)[0] == range(stop, 2 * len(spin) - stop)


def swing(start, frames, *, size=0.2, decay=1.5, period=0.8, count=7):
    """Return points that stay until a stop and then swing to rest, each its own way, of `size` m (rms)."""
    t = (torch.arange(frames) - start).clamp_min(0) / FPS
    x = size * torch.exp(-decay * t) * torch.cos(2 * math.pi * t / period)
    ways = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    ways = ways / ways.square().sum(-1).mean().sqrt()
    return x[:, None, None] * ways + torch.tensor([0.3, 0.0, 0.1])


def extreme(size, decay, period):
    """Return how far a swing goes to the other side, mm: where its derivative is first 0."""
    omega = 2 * math.pi / period
    lag = math.atan(decay / omega)
    return 1000 * size * math.exp(-decay * (math.pi - lag) / omega) * math.cos(lag)


def test_overshoot_and_settling_of_a_damped_swing_are_as_computed():
    stop = range(20, 20 + 181)
    true, soft = swing(20, 220, decay=1.5), swing(20, 220, size=0.1, decay=3.0)
    found = measure_stop(stop, soft, true, FPS)
    assert (found.frame, found.seconds) == (20, 6.0)
    assert found.overshoot_true == pytest.approx(extreme(0.2, 1.5, 0.8), rel=0.02)
    assert found.overshoot == pytest.approx(extreme(0.1, 3.0, 0.8), rel=0.02)
    # The first step is of s = x(0) - x(1 / 30); speeds fall below a fifth of it as their envelope does.
    omega, slow = 2 * math.pi / 0.8, 0.2 * float((true[21] - true[20]).square().sum(-1).mean().sqrt()) * FPS
    for settle, size, decay in ((found.settle_true, 0.2, 1.5), (found.settle, 0.1, 3.0)):
        envelope = math.log(size * math.hypot(omega, decay) / slow) / decay
        assert envelope - 0.4 < settle <= envelope + 0.04


def test_a_garment_that_is_skinned_alone_neither_swings_nor_settles():
    true = swing(0, 90)
    found = measure_stop(range(90), torch.zeros_like(true), true, FPS)
    assert (found.settle, found.overshoot) == (0, 0)
    assert found.settle_true > 0.5
    assert found.overshoot_true > 50
    assert measure_stop(range(90), true, true, FPS).overshoot == found.overshoot_true


def test_a_garment_that_hardly_moves_says_nothing():
    still = swing(0, 90, size=1e-4)
    assert measure_stop(range(90), still, still, FPS) is None


def test_a_garment_that_has_not_settled_has_the_whole_stretch():
    true = swing(0, 31, decay=0.1)
    found = measure_stop(range(31), true, true, FPS)
    assert found.settle == found.settle_true == found.seconds == 1.0
