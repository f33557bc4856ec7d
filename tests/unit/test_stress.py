"""The stability battery finds what is wrong with rollouts whose faults are known."""

import dataclasses
import json
import math

import pytest
import torch

from dsar.avatar.avatar import Avatar
from dsar.avatar.charts import Atlas, body_chart
from dsar.avatar.rollout import roll_out
from dsar.body.files import load_body
from dsar.config import ModelConfig
from dsar.errors import MotionError
from dsar.evaluation import stress as battery
from dsar.evaluation.stress import memory
from dsar.evaluation.stress.motions import spin_and_stop, sway_motion
from dsar.evaluation.stress.rollouts import Rollout
from dsar.types import Motion
from tests.brief_battery import CASES, shorten_motions

FPS = 30.0


@pytest.fixture(scope="module")
def avatar():
    torch.manual_seed(0)
    config = ModelConfig(channels=(4, 8), heads=2, window=3, memory=2)
    made = Avatar(load_body(), Atlas.stack([body_chart(load_body(), 16)]), config, FPS).eval()
    torch.nn.init.normal_(made.network.decoder.head.weight, std=0.2)
    return made


@pytest.fixture(scope="module")
def motion():
    rotations = 0.2 * torch.sin(torch.arange(40)[:, None, None] / 8 + torch.arange(3.0)).repeat(1, 55, 1)
    return Motion(rotations, torch.zeros(40, 3), FPS, "wave")


@pytest.fixture
def pretend(monkeypatch):
    """Return a function that puts offsets (metres, alike everywhere) in the place of a rollout's."""

    def put(offset):
        class Pretended:
            def __init__(self, avatar, motion):
                self.points, self.length = len(avatar.control.cells), len(motion)

            def offsets(self):
                for frame in range(self.length):
                    yield torch.full((self.points, 3), float(offset(frame)))

            def moment(self, worst):
                return None

        monkeypatch.setattr(memory, "Rollout", Pretended)

    return put


def test_drift_is_measured_per_thousand_frames(avatar, motion, pretend):
    # 0.1 m at first, 0.3 m after 10,000 frames: 0.02 m per 1000 over a mean of 0.2 m.
    pretend(lambda frame: 0.1 + 0.2 * frame / 10_000)
    verdict = battery.run_long(avatar, motion)
    assert verdict.value == pytest.approx(0.1, rel=0.02)
    assert not verdict.passed
    pretend(lambda frame: 0.1 + 0.02 * math.sin(frame))
    assert battery.run_long(avatar, motion).passed
    pretend(lambda frame: 0.1 if frame != 77 else math.nan)
    assert battery.run_long(avatar, motion).value == math.inf
    assert battery.run_long(avatar, motion).to_json()["value"] is None


def test_a_cycle_must_come_back_to_where_it_was(avatar, motion, pretend):
    pretend(lambda frame: 0.1 * math.sin(math.pi * frame / 30))
    assert battery.run_cycle(avatar, motion).value == pytest.approx(0, abs=1e-3)
    # 60 frames a cycle, a micrometre each along three axes.
    pretend(lambda frame: frame * 1e-5)
    assert battery.run_cycle(avatar, motion).value == pytest.approx(60 * 0.01 * 3**0.5, rel=1e-3)


def test_cloth_must_move_on_after_a_stop_and_then_come_to_rest(avatar, motion, pretend):
    stop = spin_and_stop(motion)[1]

    def cloth(seconds):
        def offset(frame):
            after = max(frame - stop, 0) / FPS
            return 0.1 * math.sin(frame / 10) if frame < stop else 0.05 * math.exp(-after / seconds)

        return offset

    pretend(cloth(0.4))
    verdict = battery.run_stop(avatar, motion)
    assert verdict.passed
    assert verdict.value == pytest.approx(math.exp(-3 / 0.4), rel=0.05)
    assert verdict.curve[0] == pytest.approx(50 * 3**0.5, rel=0.01)
    pretend(cloth(2.0))
    assert not battery.run_stop(avatar, motion).passed
    pretend(cloth(0.001))
    assert battery.run_stop(avatar, motion).value < 1e-6
    assert not battery.run_stop(avatar, motion).present


def test_twins_meet_where_the_state_is_forgotten_and_only_there(avatar, motion, monkeypatch):
    shorten_motions(monkeypatch)
    assert battery.run_twin(avatar, motion).curve[0] > 0
    blind = Avatar(load_body(), Atlas.stack([body_chart(load_body(), 16)]), avatar.model, FPS).eval()
    assert battery.run_twin(blind, motion).value == 0

    class Elephant(Avatar):
        """Never forgets: adds its previous offset to the next."""

        def forward_frame(self, motion_window, state, cloth=None, **streams):
            output, after, maps = super().forward_frame(motion_window, state, cloth, **streams)
            offset = output.offset + state.offsets[:, -1]
            after = dataclasses.replace(after, offsets=torch.cat([after.offsets[:, 1:], offset[:, None]], 1))
            return dataclasses.replace(output, offset=offset), after, maps

    blind.__class__ = Elephant
    verdict = battery.run_twin(blind, motion)
    assert not verdict.passed
    # 2 cm along each of three axes, at a handful of points.
    assert verdict.curve[-1] == verdict.curve[0] == pytest.approx(20 * 3**0.5, rel=0.5)


def test_a_jump_of_the_body_does_not_reach_its_clothes(avatar, motion):
    verdict = battery.run_teleport(avatar, motion)
    assert verdict.curve[len(motion) // 2 - 1] == 0
    assert verdict.value < 0.1 * max(battery.run_causal(avatar, motion).curve)


def test_other_rates_of_the_same_motion_are_compared_at_the_avatar_s(avatar, motion):
    verdict = battery.run_rate(avatar, motion)
    assert verdict.curve[0] > 0
    assert max(verdict.curve[1:]) < 1e-2
    own = max(verdict.details["body_mm_at_15"], verdict.details["simulated_mm_at_15"])
    assert own > 0
    assert verdict.value == pytest.approx(max(verdict.curve[0] - own, 0), abs=1e-3)
    assert verdict.details["velocity_ratio"] == pytest.approx(1, abs=0.1)


def test_a_sway_is_periodic_and_begins_at_rest(motion):
    sway, period = sway_motion(motion, 4)
    assert period == 60
    torch.testing.assert_close(sway.rotations[0], motion.rotations[0])
    torch.testing.assert_close(sway.rotations[60:120], sway.rotations[120:180], atol=1e-5, rtol=0)


def test_every_case_says_what_it_found_why_and_when(avatar, motion, monkeypatch):
    shorten_motions(monkeypatch)
    found = dict(battery.stress(avatar, motion.slice(0, 12), CASES))
    assert list(found) == list(battery.CASES)
    for name, verdict in found.items():
        assert math.isfinite(verdict.value), name
        assert verdict.curve, name
        assert len(verdict.reason) > 40, name
        if name == "prior":
            assert verdict.value == 0, "this avatar has none"
            continue
        assert verdict.frame is not None, name
        assert verdict.moment is not None, name
        frames, gaussians = verdict.moment.frames, verdict.moment.gaussians
        assert list(frames) == sorted(set(frames)), name
        assert len(gaussians) == len(frames) > 0, name
        assert all(len(each) == avatar.num_gaussians for each in gaussians), name
    content = battery.BatteryVerdict(found, dict.fromkeys(found, 1.0)).to_json()
    assert json.loads(json.dumps(content)) == content
    assert content["tried"] == len(battery.CASES) == 19
    assert {"pass", "value", "threshold"} <= content["cases"]["gap"].keys()


def test_a_motion_that_is_too_short_is_told(avatar, motion):
    with pytest.raises(MotionError, match="motion wave has 3 frames, the battery needs 4"):
        next(battery.stress(avatar, motion.slice(0, 3)))


def test_a_moment_is_the_rollout_s_own_frames(avatar, motion):
    rollout = Rollout(avatar, motion)
    list(rollout.offsets())
    moment = rollout.moment(20)
    assert moment.frames == (12, 16, 20, 24, 28)
    exact = roll_out(avatar, motion, frames=[1001 + frame for frame in moment.frames])
    for ours, (_, theirs) in zip(moment.gaussians, exact, strict=True):
        assert torch.equal(ours.means, theirs.means)
    assert rollout.moment(0).frames == (0, 4, 8)
    assert rollout.moment(39).frames == (31, 35, 39)
