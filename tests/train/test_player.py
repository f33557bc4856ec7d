"""The player: any order of seeks plays the same frames, to the last bit, as a rollout from the start."""

import dataclasses
import itertools
import random

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dsar.avatar import player as module
from dsar.avatar.avatar import Avatar
from dsar.avatar.charts import Atlas, body_chart
from dsar.avatar.guards import LIMITS, Guard
from dsar.avatar.player import Player
from dsar.avatar.rollout import roll_out
from dsar.body.files import load_body
from dsar.config import ModelConfig
from dsar.types import Gaussians, Motion

FRAMES = 40
SEEKS = st.lists(st.tuples(st.integers(0, FRAMES - 1), st.integers(1, 4)), min_size=1, max_size=8)


def dance(frames: int = FRAMES, **changes: torch.Tensor) -> Motion:
    generator = torch.Generator().manual_seed(4)
    rotations = 0.05 * torch.randn(frames, 55, 3, generator=generator).cumsum(0)
    return Motion(rotations, torch.zeros(frames, 3), 30.0, "dance")


def make_avatar(**changes: object) -> Avatar:
    torch.manual_seed(0)
    model = ModelConfig(**{"channels": (8, 16), "heads": 2, "window": 3, "memory": 2, **changes})
    made = Avatar(load_body(), Atlas.stack([body_chart(load_body(), 32)]), model, 30.0)
    made.fit_input_statistics([made.driving_signal(dance())])
    torch.nn.init.normal_(made.network.decoder.head.weight, std=0.2)
    return made.eval()


@pytest.fixture(scope="module", params=[{}, {"wiring": "shared"}], ids=["perframe", "shared"])
def avatar(request) -> Avatar:
    return make_avatar(**request.param)


@pytest.fixture(scope="module")
def whole(avatar) -> list[Gaussians]:
    return [gaussians for _, gaussians in roll_out(avatar, dance())]


def same(one: Gaussians, two: Gaussians) -> bool:
    return all(
        torch.equal(getattr(one, field.name), getattr(two, field.name)) for field in dataclasses.fields(one)
    )


@settings(max_examples=12, deadline=None, derandomize=True)
@given(seeks=SEEKS)
def test_every_order_of_seeks_plays_the_frames_of_the_rollout(avatar, whole, seeks):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "SNAPSHOT_FRAMES", 5)
        player = Player(avatar, avatar.driving_signal(dance()))
        for frame, count in seeks:
            player.seek(frame)
            assert player.next_frame == frame
            for _ in range(min(count, FRAMES - frame)):
                played = player.step()
                assert same(played.gaussians, whole[played.number])


def test_going_back_takes_few_steps_and_snapshots_stay_few(avatar, monkeypatch):
    monkeypatch.setattr(module, "SNAPSHOT_FRAMES", 2)
    monkeypatch.setattr(module, "MAX_SNAPSHOTS", 6)
    player = Player(avatar, avatar.driving_signal(dance()))
    player.seek(FRAMES - 1)
    assert sorted(player._snapshots) == [0, 8, 16, 24, 32]
    steps, forward_frame = [], player.forward_frame

    def counted():
        steps.append(player.next_frame)
        return forward_frame()

    monkeypatch.setattr(player, "forward_frame", counted)
    player.seek(19)
    assert steps == [16, 17, 18]
    player.seek(21)
    assert steps[3:] == [19, 20], "on from where it is"
    player.seek(33)
    assert steps[5:] == [32], "from a snapshot ahead"


def test_a_frame_outside_the_motion_is_refused(avatar):
    player = Player(avatar, avatar.driving_signal(dance(3)))
    for frame in (-1, 3):
        with pytest.raises(IndexError, match="dance, which has 3"):
            player.seek(frame)
    for number in range(3):
        assert player.step().number == number
    with pytest.raises(IndexError, match="dance ends after 3 frames"):
        player.step()


def fired(avatar: Avatar, motion: Motion) -> list[frozenset[Guard]]:
    player = Player(avatar, avatar.driving_signal(motion))
    return [player.step().fired for _ in range(len(motion))]


def test_guards_fire_where_their_limits_are_passed_and_only_there():
    avatar = make_avatar()
    torch.nn.init.zeros_(avatar.network.decoder.head.weight)
    still = Motion(torch.zeros(12, 55, 3), torch.zeros(12, 3), 30.0)
    assert fired(avatar, still) == [frozenset()] * 12

    # The pelvis passes 12 m/s: a jump, after which the past has gone along.
    jumped = dataclasses.replace(still, translations=still.translations.clone())
    jumped.translations[6:, 0] = 5.0
    assert fired(avatar, jumped) == [frozenset({Guard.JUMP} if frame == 6 else ()) for frame in range(12)]

    # An arm that swings about its shoulder faster than the limit, while the body stays.
    swung = dataclasses.replace(still, rotations=still.rotations.clone())
    swung.rotations[6:, 16, 2] = 3.1
    found = fired(avatar, swung)
    assert found[5] == found[8] == frozenset()
    assert found[6] == {Guard.SPEED}

    # A body that falls over at once: its head is more than a metre from where it was for long.
    beyond = dataclasses.replace(avatar.model, mean_time_constants=(2.0,))
    slow = Avatar(avatar.body, avatar.atlas, beyond, 30.0).eval()
    assert found[7] == frozenset() == fired(slow, still)[-1]
    fallen = dataclasses.replace(still, rotations=still.rotations.clone())
    fallen.rotations[6:, 0, 0] = 1.5
    fallen.rotations[7:, 0, 0] = 3.0
    assert fired(slow, fallen)[8:] == [frozenset({Guard.LAG})] * 4


def test_guards_see_offsets_near_their_limit_and_poses_out_of_range():
    avatar = make_avatar(pose_components=4, offset_limit=0.3)
    wild = dataclasses.replace(dance(), rotations=3 * dance().rotations)
    player = Player(avatar, avatar.driving_signal(wild))
    for _, frame in zip(range(20), iter(player.forward_frame, None), strict=False):
        near = bool((frame.output.offset.abs() > LIMITS.offset * 0.3).any())
        assert bool(frame.guard_counts[Guard.OFFSET][0] > 0) == near
    seen = frozenset(itertools.chain.from_iterable(fired(avatar, wild)))
    assert {Guard.OFFSET, Guard.POSE} <= seen


def test_random_seeks_over_a_long_motion_agree_too():
    avatar = make_avatar(window=2)
    motion = dance(200)
    player, order = Player(avatar, avatar.driving_signal(motion)), random.Random(0)
    offsets = [Player.forward_frame(player).output.offset.clone() for _ in range(200)]
    for frame in order.sample(range(200), 12):
        player.seek(frame)
        assert torch.equal(player.forward_frame().output.offset, offsets[frame])
