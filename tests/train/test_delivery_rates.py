"""Rollouts delivered at other rates than the avatar's: the same seconds, posed where they truly are."""

import copy
import dataclasses
import itertools
import math

import pytest
import torch

from dsar.avatar.avatar import Avatar
from dsar.avatar.charts import Atlas, body_chart
from dsar.avatar.player import Player
from dsar.avatar.rollout import roll_out
from dsar.body.files import load_body
from dsar.body.skinning import forward_kinematics, skin_points
from dsar.config import ModelConfig
from dsar.data.motions.files import resample
from dsar.errors import MotionError
from dsar.geometry.frame_rates import exact_rate
from dsar.types import Gaussians, Motion
from dsar_render.triplets import FrameTriplet

RATES = [24.0, 24000 / 1001, 25.0, 30.0, 48.0, 60.0]
FRAMES = 22
SPIN = 4 * math.pi
"""Radians per second: two turns."""


@pytest.fixture(scope="module")
def skinned() -> Avatar:
    """An avatar whose network adds nothing."""
    torch.manual_seed(0)
    config = ModelConfig(channels=(8, 16), heads=2, window=3, memory=2, sh_degree=1)
    made = Avatar(load_body(), Atlas.stack([body_chart(load_body(), 32)]), config, 30.0)
    torch.nn.init.normal_(made.template.harmonics, std=0.2)
    made.fit_input_statistics([made.driving_signal(spin())])
    return made.eval()


@pytest.fixture(scope="module")
def avatar(skinned) -> Avatar:
    """One whose network changes everything in every frame."""
    made = copy.deepcopy(skinned)
    torch.nn.init.normal_(made.network.decoder.head.weight, std=0.2)
    return made


def spin(fps: float = 30.0, seconds: float = (FRAMES - 1) / 30) -> Motion:
    """Return a body that spins, raises an arm and rises, each at a constant rate."""
    t = torch.arange(math.floor(seconds * fps + 1e-6) + 1) / fps
    rotations, translations = torch.zeros(len(t), 55, 3), torch.zeros(len(t), 3)
    rotations[:, 0, 1] = SPIN * t
    rotations[:, 16, 2] = 3 * t - 1
    translations[:, 1] = t
    return Motion(rotations, translations, fps, "spin")


def skin(avatar: Avatar, motion: Motion) -> list[torch.Tensor]:
    """Return the template's Gaussians on the motion's own poses."""
    transforms = forward_kinematics(avatar.body, motion.rotations, motion.translations)
    return [skin_points(avatar.template.means.detach(), avatar.texel_weights, each) for each in transforms]


def fields(gaussians: Gaussians) -> list[torch.Tensor]:
    return [getattr(gaussians, each.name) for each in dataclasses.fields(gaussians)]


def same(one: Gaussians, two: Gaussians) -> bool:
    return all(torch.equal(a, b) for a, b in zip(fields(one), fields(two), strict=True))


@pytest.mark.parametrize("fps", RATES)
def test_frames_lie_by_seconds_and_are_the_rollouts_own_where_they_meet(avatar, fps):
    motion = spin()
    rolled = roll_out(avatar, motion)
    own = [gaussians for _, gaussians in rolled]
    sequence = roll_out(avatar, motion, delivered=resample(motion, fps))
    ratio = 30 / exact_rate(fps)
    last = math.floor((FRAMES - 1) / ratio)
    assert (list(sequence.frame_numbers), sequence.fps) == (list(range(1001, 1002 + last)), fps)
    meetings = 0
    for number, gaussians in sequence:
        assert not any(field.requires_grad for field in fields(gaussians))
        time = (number - 1001) * ratio
        places = sequence.binding.T_world_rest[number - 1001]
        if time.denominator == 1:
            meetings += 1
            assert same(gaussians, own[int(time)])
            assert torch.equal(places, rolled.binding.T_world_rest[int(time)])
        else:
            assert not any(torch.equal(gaussians.means, each.means) for each in own)
    # Of 30, 24 meets every fifth frame and 25 every sixth, 48 every fifth, 60 all, 23.976 the first alone.
    assert meetings == {24.0: 5, 25.0: 4, 30.0: 22, 48.0: 5, 60.0: 22}.get(fps, 1)


@pytest.mark.parametrize("fps", [24.0, 24000 / 1001, 60.0, 120.0])
def test_a_skinned_body_is_where_its_motion_has_it_at_that_time(skinned, fps):
    motion, truth = spin(), spin(fps)
    found = roll_out(skinned, motion, delivered=resample(motion, fps))
    assert len(found) == len(truth)
    for (_, gaussians), expected in zip(found, skin(skinned, truth), strict=True):
        assert (gaussians.means - expected).norm(dim=1).max() < 2e-5
    # What a line between posed frames would make of it.
    (_, first), (_, second) = itertools.islice(roll_out(skinned, motion), 2)
    chord = FrameTriplet(1001, first, following=second).interpolate(0.5).means
    assert (chord - skin(skinned, spin(60.0))[1]).norm(dim=1).max() > 0.01


def test_a_motion_at_the_rate_of_delivery_is_followed_frame_by_frame(skinned):
    """What happens between the network's steps is not lost."""
    fine = spin(60.0)
    rotations = fine.rotations.clone()
    rotations[1::2, 16, 2] += 0.3
    fine = dataclasses.replace(fine, rotations=rotations)
    found = roll_out(skinned, resample(fine, 30.0), delivered=resample(fine, 60.0))
    for (_, gaussians), expected in zip(found, skin(skinned, fine), strict=True):
        assert (gaussians.means - expected).norm(dim=1).max() < 2e-5


def test_between_steps_raw_values_change_in_a_line(avatar):
    still = Motion(torch.zeros(FRAMES, 55, 3), torch.zeros(FRAMES, 3), 30.0)
    own = [gaussians for _, gaussians in roll_out(avatar, still)]
    found = [gaussians for _, gaussians in roll_out(avatar, still, delivered=resample(still, 120.0))]
    assert (own[1].means - own[0].means).norm(dim=1).max() > 1e-3
    before, quarter, after = own[0], found[1], own[1]
    assert torch.allclose(quarter.means, torch.lerp(before.means, after.means, 0.25), atol=1e-6)
    assert torch.allclose(quarter.harmonics, torch.lerp(before.harmonics, after.harmonics, 0.25), atol=1e-5)
    scales = torch.lerp(before.scales.log(), after.scales.log(), 0.25).exp()
    assert torch.allclose(quarter.scales, scales, rtol=1e-4)
    logits = torch.lerp(before.opacities.logit(), after.opacities.logit(), 0.25)
    assert torch.allclose(quarter.opacities.logit(), logits, atol=1e-3)


@pytest.mark.parametrize("fps", [24000 / 1001, 60.0])
def test_any_frames_alone_are_those_of_the_whole(avatar, fps):
    motion = spin()
    delivered = resample(motion, fps)
    whole = roll_out(avatar, motion, delivered=delivered)
    every = dict(whole)
    for chunk in ([1001], [1004, 1005, 1006], [1012, 1007], [whole.frame_numbers[-1]]):
        part = roll_out(avatar, motion, delivered=delivered, frames=chunk)
        assert list(part.frame_numbers) == sorted(chunk)
        for index, (number, gaussians) in enumerate(part):
            assert same(gaussians, every[number])
            assert torch.equal(part.binding.T_world_rest[index], whole.binding.T_world_rest[number - 1001])


@pytest.mark.parametrize(
    ("fps", "frame", "steps"), [(24.0, 1005, 6), (24.0, 1006, 8), (60.0, 1002, 2), (30.0, 1003, 3)]
)
def test_the_network_goes_no_farther_than_the_last_frame_needs(avatar, monkeypatch, fps, frame, steps):
    made = []
    forward_frame = Player.forward_frame

    def counted(player):
        made.append(player.next_frame)
        return forward_frame(player)

    monkeypatch.setattr(Player, "forward_frame", counted)
    motion = spin()
    assert len(list(roll_out(avatar, motion, delivered=resample(motion, fps), frames=[frame]))) == 1
    assert len(made) == steps


def test_nothing_is_blended_across_a_cut(skinned):
    motion = Motion(torch.zeros(FRAMES, 55, 3), torch.zeros(FRAMES, 3), 30.0)
    motion.translations[10:, 0] = 5.0
    found = roll_out(skinned, motion, delivered=resample(motion, 120.0), frames=range(1037, 1043))
    here, *_, there = (gaussians.means for _, gaussians in found)
    sides = [bool(gaussians.means[:, 0].mean() > 2.5) for _, gaussians in found]
    assert sides == [False, False, False, True, True, True]
    for (_, gaussians), beyond, places in zip(found, sides, found.binding.T_world_rest, strict=True):
        assert torch.allclose(gaussians.means, there if beyond else here, atol=1e-5)
        assert float(places[0, 0, 3]) == (5.0 if beyond else 0.0)


def test_a_motion_finer_than_the_avatar_is_delivered_to_its_end(skinned):
    """The network's last step may be up to a frame before it: its residuals stay, the body goes on."""
    fine = spin(120.0).slice(0, 8)
    motion = resample(fine, 30.0)
    found = list(roll_out(skinned, motion, delivered=resample(fine, 60.0)))
    assert (len(motion), len(found)) == (2, 4)
    assert (found[-1][1].means - skin(skinned, fine)[6]).norm(dim=1).max() < 2e-5


def test_a_delivery_of_more_than_the_motion_is_refused(skinned):
    motion = spin()
    with pytest.raises(MotionError, match=r"a delivery of its 0\.733333 s, found 22 frames at 24 a second"):
        roll_out(skinned, motion, delivered=dataclasses.replace(motion, fps=24.0))
    with pytest.raises(MotionError, match="1001-1017"):
        roll_out(skinned, motion, delivered=resample(motion, 24.0), frames=[1018])
