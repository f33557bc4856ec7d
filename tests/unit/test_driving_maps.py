"""What drives the network in training: the table says what each frame's input maps are, mirrored or not."""

import dataclasses

import pytest
import torch

from dsar.avatar.avatar import Avatar
from dsar.avatar.mirror import Mirror, mirror_motion
from dsar.config import TrainConfig
from dsar.data.captures.formats import open_capture
from dsar.training.driving_maps import DrivingMaps, frame_bytes
from dsar.training.rollouts import RolloutCursor

PLACES = [("walk", 0, False), ("sway", 7, True), ("walk", 31, True), ("sway", 7, False), ("walk", 5, False)]


@pytest.fixture(scope="module")
def driven():
    torch.manual_seed(0)
    config, capture = TrainConfig(), open_capture("embedded")
    avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model).train()
    avatar.place_prior()
    assert avatar.prior is not None
    for garment in avatar.prior.garments:
        garment.trust.fill_(0.5)
    return avatar, {name: avatar.driving_signal(capture.motions[name]) for name in ("walk", "sway")}


@pytest.mark.parametrize("kept", [True, False], ids=["table", "as they are wanted"])
def test_a_rollout_is_driven_by_the_maps_of_its_own_frame_or_of_its_mirror_image(driven, kept):
    avatar, signals = driven
    capacity = 1 << 28 if kept else 0
    cursors = [RolloutCursor(name, frame, 0, mirrored) for name, frame, mirrored in PLACES]
    frames = DrivingMaps(avatar, signals, mirrored=True, capacity=capacity).gather(cursors)
    mirror = Mirror(avatar.control)
    for index, (name, frame, mirrored) in enumerate(PLACES):
        window = signals[name].windows[[frame]]
        window = mirror_motion(window) if mirrored else window
        cloth = mirror.mirror_cloth(signals[name].cloth_at([frame]), torch.tensor([mirrored]))
        inputs = avatar.input_maps(window, avatar.fps, cloth)
        maps, magnitude = avatar.standardize(inputs)
        torch.testing.assert_close(frames.maps[[index]], maps)
        torch.testing.assert_close(frames.magnitude[[index]], magnitude)
        torch.testing.assert_close(frames.speed[[index]], inputs.magnitude)
        torch.testing.assert_close(frames.base[[index]], avatar.offset_base(cloth))
        still = avatar.offset_garment(torch.zeros(1, len(avatar.garment_control_points()), 3))
        torch.testing.assert_close(
            avatar.pose_control_points(frames.control_transforms[[index]], still),
            avatar.deformed_control_points(window, still),
        )


def test_a_table_that_does_not_fit_is_not_made(driven):
    avatar, signals = driven
    needed = 2 * sum(map(len, signals.values())) * frame_bytes(avatar)
    made = DrivingMaps(avatar, signals, mirrored=True, capacity=needed)._table
    assert made is not None
    assert DrivingMaps(avatar, signals, mirrored=True, capacity=needed - 1)._table is None
    fields = (getattr(made, field.name) for field in dataclasses.fields(made))
    assert sum(values.numel() * values.element_size() for values in fields) == needed
