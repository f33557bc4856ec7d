"""Avatars with a fault that is known are caught, each by a case that is named here; a sound one is not."""

import dataclasses

import pytest
import torch

from dsar.avatar import driving
from dsar.avatar.avatar import Avatar
from dsar.avatar.input_maps import REFERENCE_FPS
from dsar.dynamics.cloth import ClothConstants
from dsar.evaluation import stress as battery
from dsar.evaluation.stress import analysis, strain
from dsar.evaluation.stress.rollouts import Rollout
from dsar.network import NetworkOutput
from dsar.network.session import InferenceSession
from tests.loose_cloth import FPS, skirt_avatar, striding

GAIN = 1.02


def make_avatar(prior: str = "none") -> Avatar:
    avatar = skirt_avatar(prior=prior)
    torch.manual_seed(1)
    torch.nn.init.normal_(avatar.network.decoder.head.weight, std=0.02)
    return avatar


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return make_avatar()


@pytest.fixture(scope="module")
def walk():
    return striding(50, 1, "walk")


class Amplifier(Avatar):
    """Adds more than its previous offset to the next."""

    def forward_frame(self, motion_windows, state, cloth=None, **streams):
        output, after, maps = super().forward_frame(motion_windows, state, cloth, **streams)
        offset = output.offset + GAIN * state.offsets[:, -1]
        after = dataclasses.replace(after, offsets=torch.cat([after.offsets[:, 1:], offset[:, None]], 1))
        return dataclasses.replace(output, offset=offset), after, maps


def test_feedback_with_a_gain_above_1_fails_twin(avatar, walk):
    walk = walk.slice(10, 30)
    assert battery.run_twin(avatar, walk).passed
    faulty = make_avatar()
    faulty.__class__ = Amplifier
    assert not battery.run_twin(faulty, walk).passed
    # And it is what the analysis says that it is.
    assert analysis.lyapunov_exponent(avatar, walk) < 0 < analysis.lyapunov_exponent(faulty, walk)
    assert analysis.half_life(faulty, walk) > 1 > analysis.half_life(avatar, walk)
    sound, more = (analysis.loop_gains(each, walk)["offsets"] for each in (avatar, faulty))
    assert sound.largest < 1 < more.largest
    assert sound.mean <= sound.largest


def test_a_state_that_is_not_reset_fails_causal(avatar, walk, monkeypatch):
    assert battery.run_causal(avatar, walk).passed
    honest, sessions = InferenceSession.__init__, []

    def sticky(self, *arguments, **keywords):
        honest(self, *arguments, **keywords)
        if sessions:
            self.restore(sessions[-1].snapshot())
        sessions.append(self)

    monkeypatch.setattr(InferenceSession, "__init__", sticky)
    list(Rollout(avatar, walk).offsets())
    assert not battery.run_causal(avatar, walk).passed


def test_a_state_that_is_not_reset_at_a_cut_fails_teleport(avatar, walk, monkeypatch):
    assert battery.run_teleport(avatar, walk).passed
    monkeypatch.setattr(driving, "find_jumps", lambda *_: [])
    assert not battery.run_teleport(avatar, walk).passed


def test_velocities_by_the_frame_and_not_by_the_second_fail_rate(avatar, walk, monkeypatch):
    assert battery.run_rate(avatar, walk).present
    honest = Avatar.input_maps
    monkeypatch.setattr(
        Avatar,
        "input_maps",
        lambda self, windows, fps, cloth=None: honest(self, windows, REFERENCE_FPS, cloth),
    )
    verdict = battery.run_rate(avatar, walk)
    assert verdict.details["velocity_ratio"] == pytest.approx(0.5, abs=0.05)
    assert not verdict.passed


def test_a_look_into_the_future_fails_causal(avatar, walk, monkeypatch):
    assert battery.run_causal(avatar, walk).passed
    honest = Rollout.frames

    def peeking(self):
        future = self.player.signal.transforms[-1, 5, :3, 3].sum()
        for frame in honest(self):
            output = NetworkOutput(frame.output.offset + 1e-3 * future, frame.output.appearance, ())
            yield dataclasses.replace(frame, output=output)

    monkeypatch.setattr(Rollout, "frames", peeking)
    assert not battery.run_causal(avatar, walk).passed


def test_a_prior_without_damping_fails_prior(walk):
    avatar = make_avatar("cloth")
    assert battery.run_prior(avatar, walk).passed
    garment = avatar.prior.garments[0]
    undamped = ClothConstants(drag=0.0, damping=0.0, viscosity=0.0, homing=0.0, friction=0.0)
    garment.constants.copy_(torch.from_numpy(undamped.to_vector()))
    verdict = battery.run_prior(avatar, walk)
    assert not verdict.passed
    assert verdict.details["mm_after_spin"] > 5


def test_torn_swollen_and_leaping_cloth_is_near_to_broken(avatar, walk):
    sound = strain.measure_strain(avatar, walk)
    assert sound.breakage.amax() < 1
    assert float(sound.stretch[0]) == pytest.approx(1, abs=0.6)
    assert sound.leap[0] == 0

    class Torn(Rollout):
        def frames(self):
            for frame in super().frames():
                offset = frame.output.offset.clone()
                if frame.number == 30:
                    offset[..., ::2] += 0.45
                yield dataclasses.replace(frame, output=dataclasses.replace(frame.output, offset=offset))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(strain, "Rollout", Torn)
        torn = strain.measure_strain(avatar, walk)
    assert int(torn.breakage.argmax()) in (30, 31)
    assert torn.stretch[30] > 4
    assert torn.leap[30] == pytest.approx(0.45 * 3**0.5, rel=0.1)
    assert torch.equal(torn.breakage[:30], sound.breakage[:30])


def test_cloth_inside_the_body_is_counted(avatar, walk):
    class Sunk(Rollout):
        def frames(self):
            for frame in super().frames():
                offset = torch.zeros_like(frame.output.offset)
                # Along the outward normal.
                offset[:, 2] = -0.12 if frame.number == 9 else 0.0
                yield dataclasses.replace(frame, output=dataclasses.replace(frame.output, offset=offset))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(strain, "Rollout", Sunk)
        inside = strain.measure_strain(avatar, walk.slice(0, 10)).inside
    assert inside[9] > inside[:9].amax() + 0.2


def test_an_analysis_is_of_each_motion_and_is_written_without_infinities(avatar, walk):
    found = analysis.analyse(avatar, walk, {"walk": walk, "start": walk.slice(0, 20)})
    assert list(found.lyapunov) == ["walk", "start"]
    content = dataclasses.replace(found, half_life=float("inf")).to_json()
    assert content["half_life_s"] is None
    assert content["loop_gain"]["offsets"]["max"] >= content["loop_gain"]["offsets"]["mean"] > 0
    assert content["loop_gain"].keys() == {"offsets", "memory"}
    assert len(analysis.describe_analysis(found)) == 3


def test_gains_are_singular_values_of_the_step(avatar, walk):
    """Against all columns of the Jacobian of a map that is small enough to have them."""
    torch.manual_seed(0)
    matrices = torch.randn(2, 5, 7)
    at = torch.randn(2, 7)
    found = analysis._spectral_norm(lambda x: (matrices @ x.tanh()[..., None])[..., 0], at)
    jacobians = matrices * (1 - at.tanh().square())[:, None]
    torch.testing.assert_close(found, torch.linalg.matrix_norm(jacobians, 2), rtol=0.02, atol=0)
    assert FPS == avatar.fps
