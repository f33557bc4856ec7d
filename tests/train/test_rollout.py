"""Rollouts of a network with random weights: causality, equivariance, and long-run bounds."""

import dataclasses

import pytest
import torch

from dsar.avatar.avatar import Avatar
from dsar.avatar.charts import Atlas, body_chart
from dsar.avatar.rollout import network_outputs, roll_out
from dsar.body.files import load_body
from dsar.config import ModelConfig
from dsar.data.motions.files import rotate_motion
from dsar.errors import MotionError
from dsar.geometry.rotations import matrix_from_axis_angle, matrix_from_quaternion
from dsar.types import Motion

KINDS = [("perframe", "surface"), ("late", "surface"), ("shared", "body")]


@pytest.fixture(scope="module", params=KINDS, ids="-".join)
def avatar(request):
    torch.manual_seed(0)
    body = load_body()
    wiring, axes = request.param
    config = ModelConfig(wiring=wiring, axes=axes, channels=(8, 16), heads=2, window=4, memory=3, sh_degree=1)
    made = Avatar(body, Atlas.stack([body_chart(body, 32)]), config, 30.0)
    torch.nn.init.normal_(made.network.decoder.head.weight, std=0.2)
    torch.nn.init.normal_(made.template.harmonics, std=0.2)
    made.fit_input_statistics([made.driving_signal(dance(60))])
    return made.eval()


def dance(frames: int) -> Motion:
    generator = torch.Generator().manual_seed(3)
    t = torch.arange(frames)[:, None, None] / 30
    phase, speed = 6 * torch.rand(55, 3, generator=generator), 1 + 3 * torch.rand(55, 3, generator=generator)
    rotations = 0.25 * torch.sin(speed * t + phase)
    rotations[:, 0] = torch.stack([0.1 * t[:, 0, 0].sin(), 2 * t[:, 0, 0], 0 * t[:, 0, 0]], -1)
    translations = 0.3 * torch.sin(t[:, 0] * torch.tensor([1.0, 2.0, 0.5]))
    return Motion(rotations, translations, 30.0, "dance")


def test_the_future_never_changes_the_past(avatar):
    motion = dance(12)
    changed = motion.rotations.clone()
    changed[8:] += 0.5
    other = dataclasses.replace(motion, rotations=changed)
    pairs = zip(roll_out(avatar, motion), roll_out(avatar, other), strict=True)
    for frame, ((_, one), (_, two)) in enumerate(pairs):
        same = all(torch.equal(getattr(one, f.name), getattr(two, f.name)) for f in dataclasses.fields(one))
        assert same == (frame < 8)


def test_turning_and_shifting_the_motion_turns_and_shifts_the_gaussians(avatar):
    motion, turn = dance(10), matrix_from_axis_angle(torch.tensor([0.0, 1.3, 0.0]))
    shift = torch.tensor([2.0, 0.0, -1.0])
    turned = rotate_motion(motion, avatar.body, turn)
    turned = dataclasses.replace(turned, translations=turned.translations + shift)
    for (_, one), (_, two) in zip(roll_out(avatar, motion), roll_out(avatar, turned), strict=True):
        assert torch.allclose(two.means, one.means @ turn.T + shift, atol=2e-4)
        assert torch.allclose(
            matrix_from_quaternion(two.rotations), turn @ matrix_from_quaternion(one.rotations), atol=2e-3
        )
        assert torch.allclose(two.scales, one.scales, rtol=2e-3)
        assert torch.allclose(two.harmonics[:, 0], one.harmonics[:, 0], atol=2e-3)


def test_unfamiliar_poses_become_familiar_ones_once_trained():
    config = ModelConfig(channels=(8, 16), heads=2, pose_components=10)
    avatar = Avatar(load_body(), Atlas.stack([body_chart(load_body(), 32)]), config, 30.0)
    avatar.fit_input_statistics([avatar.driving_signal(dance(60))])
    flailing = dataclasses.replace(dance(60), rotations=3 * dance(60).rotations)

    def standardize(motion: Motion) -> torch.Tensor:
        return avatar.standardize(avatar.input_maps(avatar.driving_signal(motion).windows[:2], 30.0))[0]

    raw, wild = standardize(dance(60)), standardize(flailing)
    avatar.eval()
    near, tame = standardize(dance(60)), standardize(flailing)
    # Motion of many joints needs more than ten components, but not many more.
    assert (near - raw)[:, :3].square().mean() < 0.02 * raw[:, :3].square().mean()
    assert torch.equal(near[:, 3:], raw[:, 3:])
    statistics, poses = avatar.statistics, avatar.principal_poses

    def deviations(maps: torch.Tensor) -> torch.Tensor:
        """Return how far poses are from the mean of training along its components, in standard deviations."""
        values = maps[:, :3].flatten(2)[:, :, avatar.control.cells]
        points = values * statistics.map_scale[:3, 0] + statistics.map_mean[:3, 0]
        coefficients = (points.flatten(1) - poses.mean) @ poses.basis.mT
        return coefficients.abs() / poses.deviation

    assert deviations(wild).max() > 2
    assert deviations(tame).max() < 2.01
    assert not torch.allclose(tame[:, :3], wild[:, :3], atol=0.1)


def test_a_range_of_frames_has_the_same_history_as_the_whole(avatar):
    motion = dance(12)
    whole = dict(roll_out(avatar, motion))
    part = dict(roll_out(avatar, motion, frames=[1009, 1004]))
    assert list(part) == [1004, 1009]
    for frame, gaussians in part.items():
        assert torch.equal(gaussians.means, whole[frame].means)


def test_frames_outside_the_motion_and_foreign_rates_are_refused(avatar):
    with pytest.raises(MotionError, match="1001-1012"):
        roll_out(avatar, dance(12), frames=[1013])
    with pytest.raises(MotionError, match="24 fps"):
        roll_out(avatar, dataclasses.replace(dance(12), fps=24.0))


def test_two_thousand_frames_stay_finite_and_bounded(avatar):
    largest = []
    for _, output in network_outputs(avatar, dance(2000)):
        largest.append(float(output.offset.abs().max()))
        assert output.appearance.isfinite().all()
    # The last quarter must not be worse than the second.
    assert sum(largest[1500:]) <= 1.2 * sum(largest[500:1000])


def test_a_network_that_asks_for_metres_is_held_at_the_limit(avatar, monkeypatch):
    head = avatar.network.decoder.head
    with torch.no_grad():
        monkeypatch.setattr(head.weight, "data", 1000 * head.weight.data)
    outputs = [output for _, output in network_outputs(avatar, dance(30))]
    largest = [float(output.offset.abs().max()) for output in outputs]
    assert max(largest) == pytest.approx(avatar.model.offset_limit, rel=1e-4)
    assert max(largest) <= avatar.model.offset_limit
    assert all(output.offset.isfinite().all() for output in outputs)


def test_a_teleport_takes_the_clothes_along_and_they_go_on_as_they_would_have(avatar):
    motion, way = dance(20), torch.tensor([100.0, 0.0, 0.0])
    translations = motion.translations.clone()
    translations[10:] += way
    teleported = dataclasses.replace(motion, translations=translations)
    pairs = zip(roll_out(avatar, motion), roll_out(avatar, teleported), strict=True)
    for frame, ((_, one), (_, two)) in enumerate(pairs):
        if frame < 10:
            assert torch.equal(two.means, one.means)
        else:
            # The body's pace at the jump is taken to be that of the frame before: centimetres, at most.
            assert (two.means - way - one.means).norm(dim=1).max() < 0.05, frame


@pytest.mark.parametrize(
    ("setting", "off", "gone"),
    [
        ("velocity", False, range(3, 6)),
        ("acceleration", False, range(6, 9)),
        ("mean_time_constants", (), range(9, 18)),
    ],
)
def test_maps_that_are_switched_off_leave_the_others_and_the_speed_as_they_are(setting, off, gone):
    body, atlas = load_body(), Atlas.stack([body_chart(load_body(), 16)])
    config = ModelConfig(channels=(4, 8), heads=2, mean_time_constants=(0.1, 0.2, 0.4), prior="none")
    seen = []
    for model in (config, dataclasses.replace(config, **{setting: off})):
        avatar = Avatar(body, atlas, model, 30.0)
        motion_window = avatar.driving_signal(dance(20)).windows[5:15]
        seen.append(avatar.input_maps(motion_window, 30.0))
        assert seen[-1].maps.shape[1] == model.map_channels
    full, less = seen
    kept = [channel for channel in range(config.map_channels) if channel not in gone]
    assert all(full.maps[:, channel].abs().max() > 1e-4 for channel in range(config.map_channels))
    assert torch.equal(full.maps[:, kept], less.maps)
    assert torch.equal(full.magnitude, less.magnitude)
