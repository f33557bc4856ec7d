"""Guards never act on training motions, and on every seeded defect."""

import copy
import dataclasses
import json
import logging
import math
import random
import shutil

import pytest
import torch

import dsar
from dsar.avatar import driving
from dsar.avatar.avatar import Avatar
from dsar.avatar.charts import Atlas, body_chart
from dsar.avatar.guard_limits import BREAKING_MARGIN, GuardLimits, Jitter
from dsar.avatar.guards import Guard
from dsar.avatar.player import Player
from dsar.avatar.rollout import roll_out
from dsar.avatar.watchdog import BLEND_SECONDS, REPLACING, Watchdog
from dsar.body.files import load_body
from dsar.cli import main
from dsar.cli.export import Export
from dsar.config import ModelConfig
from dsar.network import NetworkOutput
from dsar.training.checkpoint import Run, load_checkpoint
from dsar.training.guard_limits import attach_guards, find_guard_limits, read_guard_limits
from dsar.training.scene import open_scene
from dsar.types import Motion


def sway(frames: int = 24, lean: float = 0.0, turn: float = 1.0) -> Motion:
    t = torch.arange(frames) / 30
    rotations = torch.zeros(frames, 55, 3)
    rotations[:, 16, 2], rotations[:, 17, 2] = -1.1, 1.1
    rotations[:, 3, 0] = lean + 0.4 * torch.sin(4 * t)
    rotations[:, 0, 1] = turn * t
    return Motion(rotations, torch.zeros(frames, 3), 30.0, "sway")


def noise(size: float, frames: int = 20) -> Motion:
    generator = torch.Generator().manual_seed(3)
    rotations = size * torch.randn(frames, 55, 3, generator=generator)
    return Motion(rotations, torch.zeros(frames, 3), 30.0, "noise")


@pytest.fixture(scope="module")
def sound() -> Avatar:
    """An avatar whose network says something, with guards."""
    torch.manual_seed(0)
    model = ModelConfig(channels=(4, 8), heads=2, window=2, memory=2)
    made = Avatar(load_body(), Atlas.stack([body_chart(load_body(), 32)]), model, 30.0)
    signal = made.driving_signal(sway())
    made.fit_input_statistics([signal])
    torch.nn.init.normal_(made.network.decoder.head.weight, std=0.02)
    made.eval().guard_limits = find_guard_limits(made, [signal])
    return made


@pytest.fixture
def avatar(sound) -> Avatar:
    """A copy of it, to break."""
    return copy.deepcopy(sound)


def play(avatar: Avatar, motion: Motion, **options: bool):
    """Return each frame's offsets and what guards found."""
    player = Player(avatar, avatar.driving_signal(motion), **options)
    frames = [player.forward_frame() for _ in range(len(motion))]
    return torch.cat([frame.output.offset for frame in frames]), [frame.guarded for frame in frames]


def names(found) -> list[set[str]]:
    return [set() if frame is None else set(frame.exceeded) for frame in found]


def break_weight(avatar: Avatar, factor: float) -> None:
    with torch.no_grad():
        avatar.network.decoder.head.weight[:3] *= factor


def test_rollouts_over_training_motions_are_the_same_with_and_without_guards(trained):
    guarded, bare = dsar.load(trained), dsar.load(trained)
    bare.guard_limits = None
    assert guarded.guard_limits is not None
    _, config, _ = load_checkpoint(Run(trained))
    scene = open_scene(Run(trained), config)
    for name in scene.splits["train"]:
        sequences = [roll_out(avatar, scene.motions[name]) for avatar in (guarded, bare)]
        for (_, one), (_, other) in zip(*sequences, strict=True):
            assert all(torch.equal(value, getattr(other, key)) for key, value in vars(one).items())
        assert sequences[0].guarded == {}


def test_the_farthest_training_frame_is_at_one(avatar):
    maps, outputs = [], []
    player = Player(avatar, avatar.driving_signal(sway()), guarded=False)
    for _ in range(24):
        frame = player.forward_frame()
        maps.append(avatar.standardize(avatar.input_maps(frame.motion_window, 30.0))[0])
        outputs.append(frame.own)
    limits = avatar.guard_limits
    assert float(max(limits.distance(each) for each in maps)) == pytest.approx(1.0, rel=1e-5)
    assert float(max(limits.size(each) for each in outputs)) == pytest.approx(1.0, rel=1e-5)
    # The jitter by its definition.
    offsets = torch.cat([output.offset for output in outputs]).double()
    squares = (offsets[2:] - 2 * offsets[1:-1] + offsets[:-2]).square().mean((1, 2, 3))
    decay, mean, largest = math.exp(-1 / 7.5), 0.0, 0.0
    for square in squares.tolist():
        mean = decay * mean + (1 - decay) * square
        largest = max(largest, math.sqrt(mean))
    assert limits.jitter == pytest.approx(largest, rel=1e-4)


def test_a_rollout_that_grows_is_caught_and_stays_within_training(avatar):
    limit = BREAKING_MARGIN * avatar.guard_limits.offset
    break_weight(avatar, 8.0)
    bare, _ = play(avatar, sway(), guarded=False)
    offsets, found = play(avatar, sway())
    assert bare.abs().amax() > limit
    assert offsets.abs().amax() <= limit * (1 + 1e-6)
    caught = [frame for frame in found if frame is not None and Guard.SIZE in frame.exceeded]
    assert caught
    assert all(frame.exceeded[Guard.SIZE] > BREAKING_MARGIN for frame in caught)


def test_what_feedback_alone_makes_grow_follows_from_the_pose(avatar):
    # In its first frame the network is sound; what it is told of that frame makes it say more and more.
    limits = dataclasses.replace(avatar.guard_limits, offset=1.0)
    first, _ = play(avatar, sway(1), guarded=False)
    rest, _ = play(avatar, sway(), guarded=False)
    limit = 0.5 * float(first.abs().amax() + rest.abs().amax()) / BREAKING_MARGIN
    avatar.guard_limits = dataclasses.replace(limits, offset=limit, appearance=1e3, jitter=1e3)
    offsets, found = play(avatar, sway())
    assert any(Guard.SIZE in each for each in names(found))
    assert offsets.abs().amax() <= BREAKING_MARGIN * limit * (1 + 1e-6)


def test_weights_that_are_no_numbers_leave_the_skinned_template(avatar):
    with torch.no_grad():
        avatar.network.decoder.head.weight[1, 0] = math.nan
    offsets, found = play(avatar, sway(12))
    assert play(avatar, sway(12), guarded=False)[0].isnan().any()
    assert names(found) == [{Guard.FINITE}] * 12
    assert not offsets.any()


def test_nothing_pops_where_frames_are_replaced(avatar):
    """A network that breaks in mid-motion: what is shown glides from the last sound frame to the template."""
    player = Player(avatar, avatar.driving_signal(sway()))
    for _ in range(14):
        last = player.forward_frame().output.offset.clone()
    with torch.inference_mode():
        player._session.network.decoder.head.weight[:] = math.nan
    step = 1 / round(BLEND_SECONDS * 30)
    for _ in range(10):
        frame = player.forward_frame()
        assert torch.allclose(frame.output.offset, (1 - step) * last, atol=1e-7)
        assert frame.guarded.held == pytest.approx(1 - step)
        last = frame.output.offset.clone()


class Still:
    """Makes a frame of the pose alone that says nothing."""

    def restart(self) -> NetworkOutput:
        return NetworkOutput(torch.zeros(1, 3, 4, 4), torch.zeros(1, 8, 4, 4), ())

    template = restart


def test_trembling_offsets_are_caught():
    """Each frame is within all that training shows; their order is not."""
    maps, pattern = torch.zeros(1, 6, 4, 4), torch.rand(1, 3, 4, 4)
    smooth = [math.sin(0.3 * frame) * pattern for frame in range(40)]
    trembling = [0.5 * (-1) ** frame * pattern for frame in range(40)]
    jitter, largest = Jitter.at_rate(30.0), 0.0
    for offset in smooth:
        jitter = jitter.step(offset, float(jitter.change(offset)))
        largest = max(largest, jitter.size)
    limits = GuardLimits(maps[0], torch.ones(2), 1.0, 1.0, largest)
    found = {}
    for name, offsets in (("smooth", smooth), ("trembling", trembling)):
        watchdog = Watchdog(limits, 30.0, torch.device("cpu"))
        outputs = [NetworkOutput(offset, torch.zeros(1, 8, 4, 4), ()) for offset in offsets]
        found[name] = names(watchdog.watch(maps, output, Still())[1] for output in outputs)
    assert not any(found["smooth"])
    assert set().union(*found["trembling"]) == {Guard.JITTER}


def cut() -> Motion:
    """Two shots: the second lies 10 m away, in a pose to which nobody gets in a frame."""
    one, other = sway(15), sway(15, lean=1.2, turn=-1.0)
    other.rotations[:, 16:20, 2] *= -1
    other.rotations[:, 1:3, 0] = -1.4
    other.translations[:, 0] = 10
    rotations = torch.cat([one.rotations, other.rotations])
    return Motion(rotations, torch.cat([one.translations, other.translations]), 30.0, "cut")


def test_after_a_cut_each_frame_is_that_of_the_shot_alone(avatar, caplog):
    avatar.guard_limits = dataclasses.replace(avatar.guard_limits, offset=1e3, appearance=1e3, jitter=1e3)
    whole, found = play(avatar, cut())
    assert "the pose is cut at frame 15 of 30" in caplog.text
    assert [number for number, each in enumerate(names(found)) if Guard.CUT in each] == [15]
    alone, _ = play(avatar, cut().slice(15, 30))
    assert torch.equal(whole[15:], alone)


def test_a_state_that_is_not_reset_after_a_cut_is_caught(avatar, monkeypatch):
    kept = names(play(avatar, cut())[1])
    monkeypatch.setattr(driving, "find_cuts", lambda *_: [])
    monkeypatch.setattr(driving, "find_jumps", lambda *_: [])
    broken = play(avatar, cut())[1]
    assert Guard.FAR in names(broken)[15]
    assert broken[15].exceeded[Guard.FAR] > 3
    assert Guard.CUT in kept[15]


@pytest.mark.parametrize(("size", "guard"), [(1.0, Guard.CUT), (0.2, Guard.FAR)])
def test_noise_is_caught(avatar, size, guard):
    found = names(play(avatar, noise(size))[1])
    assert sum(guard in each for each in found) > 10


def test_the_past_alone_decides(avatar):
    break_weight(avatar, 4.0)
    other = sway()
    other.rotations[16:, 16] *= -1
    (one, found), (two, others) = play(avatar, sway()), play(avatar, other)
    assert torch.equal(one[:16], two[:16])
    assert found[:16] == others[:16]
    assert any(found[:16])


def test_a_guarded_player_plays_the_same_frames_in_any_order(avatar):
    break_weight(avatar, 4.0)
    motion = sway(60)
    offsets, found = play(avatar, motion)
    assert 0 < sum(bool(each & REPLACING) for each in names(found)) < 60
    player = Player(avatar, avatar.driving_signal(motion))
    for frame in random.Random(0).sample(range(60), 6):
        player.seek(frame)
        played = player.forward_frame()
        assert torch.equal(played.output.offset[0], offsets[frame])
        assert played.guarded == found[frame]


def test_the_log_has_one_line_for_a_motion(avatar, caplog):
    sequence = roll_out(avatar, noise(0.2))
    for _ in range(2):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            assert len(list(sequence)) == 20
        lines = [record.message for record in caplog.records if "far from" in record.message]
        far = [number for number, frame in sequence.guarded.items() if Guard.FAR in frame.exceeded]
        assert len(lines) == 1
        assert f"{len(far)} of 20 frames, from {far[0]} to {far[-1]}" in lines[0]


def test_limits_of_another_avatar_are_measured_again(trained, tmp_path, caplog):
    run = Run(shutil.copytree(trained, tmp_path / "run"))
    kept = read_guard_limits(run)
    avatar, config, _ = load_checkpoint(run)
    content = run.guards.read_bytes()
    run.guards.unlink()
    attach_guards(run, avatar, lambda: open_scene(run, config))
    assert run.guards.read_bytes() == content
    found = avatar.guard_limits
    assert torch.equal(found.mean, kept.mean)
    assert found.offset == kept.offset
    file = run.checkpoint / "avatar.safetensors"
    file.write_bytes(file.read_bytes() + b" ")
    assert read_guard_limits(run) is None


def test_without_training_motions_there_are_no_guards_and_the_log_says_so(trained, tmp_path, caplog):
    run = Run(shutil.copytree(trained, tmp_path / "run"))
    run.guards.unlink()
    run.scene.unlink()
    settings = json.loads(run.config.read_text())
    run.config.write_text(json.dumps({**settings, "capture": str(tmp_path / "gone")}))
    avatar, config, _ = load_checkpoint(run)
    attach_guards(run, avatar, lambda: open_scene(run, config))
    assert avatar.guard_limits is None
    assert "No guards" in caplog.text


def test_the_flag_takes_guards_off_and_files_say_which(trained, tmp_path):
    for flags, expected in (([], "on"), (["--no-guards"], "off")):
        main(["export", str(trained), "--frames", "1001", "--ply", str(tmp_path / expected), *flags])
        manifest = json.loads((tmp_path / f"{expected}.manifest.json").read_text())
        assert manifest["provenance"]["guards"] == expected
    assert Export(run_folder=trained, no_guards=True).open().avatar.guard_limits is None
