"""Registered maps follow the true cloth of the embedded capture, and the network learns to follow them."""

import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dsar.avatar.avatar import Avatar
from dsar.config import ModelConfig, TrainConfig
from dsar.data.captures.formats import open_capture
from dsar.evaluation.garment_metrics import distance_to_mesh
from dsar.training import loop
from dsar.training.chunk import ChunkTrainer
from dsar.training.kept_views import KeptViews
from dsar.training.optimizers import set_rates
from dsar.training.registered_maps import RegisteredMaps, divide_sequences
from dsar.training.registration import Registration
from dsar.training.rest import PULL, RestOffsets
from dsar.training.schedule import schedule_at, without_pretraining
from dsar.training.state import TrainingState
from dsar.training.time_limit import TimeLimit
from dsar.training.workers import Gradients

SEQUENCE = "spin_right"
LAST = 34
"""A frame in full spin; the person stands until frame 8."""


@pytest.fixture(scope="module")
def registered():
    """A template fitted for a few updates, and the first frames of a spin registered with it."""
    torch.manual_seed(0)
    config, capture = TrainConfig(), open_capture()
    avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model)
    every = loop.training_clips(capture)
    signals = {name: avatar.driving_signal(capture.motions[name]) for name in every}
    still = loop.rest_frames(capture, signals, every, avatar.fps)
    state = TrainingState.begin(config, capture, avatar, every, still)
    trainer = ChunkTrainer(config, KeptViews(capture), state, signals, None)
    gradients = Gradients([*avatar.parameters(), *state.rest.parameters()])
    for step in range(60):
        set_rates(state.optimizers, schedule_at(config.schedule, 0.12 * step / 60))
        gradients.clear()
        trainer.backward_template(np.random.default_rng([0, step]), 1)
        state.optimizers["adam"].step()
    avatar.unhide_covered_texels()
    clips = {SEQUENCE: range(4, LAST + 1)}
    state.registered = RegisteredMaps.begin(config, capture, avatar, clips)
    registration = Registration(config, KeptViews(capture), avatar, state.rest, state.registered, signals)
    other = TrainingState.begin(config, capture, avatar, clips, still)
    copy = Registration(config, KeptViews(capture), avatar, other.rest, other.registered, signals)
    for _ in range(LAST - 5):
        registration.fit_next()
    saved = {name: value.clone() for name, value in state.state_dict().items() if "registration." in name}
    other.load_state_dict(saved)
    for fitting in (registration, copy):
        while not fitting.maps.complete:
            fitting.fit_next()
    return capture, avatar, registration, copy


def test_the_template_finds_the_cloth_and_every_still_frame_has_folds_of_its_own(registered):
    """A Gaussian lies on the same spot of the cloth in two sequences, though it hangs otherwise there."""
    capture, avatar, registration, _ = registered
    rest, garment = registration.rest, avatar.garment_texels()
    faces = torch.from_numpy(capture.garment_faces("sway"))

    def posed(index, output) -> tuple[torch.Tensor, torch.Tensor]:
        sequence, frame = rest.frames[index]
        motion_window = registration.signals[sequence].windows[[frame]]
        cloth = capture.garment(sequence)[frame]
        return avatar.gaussians(motion_window, output)[0].means[garment], torch.from_numpy(cloth)

    distances, own, shared = [], [], []
    with torch.no_grad():
        begins = {name: k for k, (name, frame) in enumerate(rest.frames) if frame == 0}
        for here, there in itertools.permutations(
            [begins[name] for name in ("sway", "walk", "turn_about")], 2
        ):
            points, cloth = posed(here, rest.output(avatar, torch.tensor([here])))
            distances.append(distance_to_mesh(points, cloth, faces))
            spots = cloth[faces].mean(1)
            nearest = torch.cdist(points, spots).argmin(1)
            moved, other = posed(there, rest.output(avatar, torch.tensor([there])))
            carried = other[faces].mean(1)[nearest] - spots[nearest]
            own.append((moved - points - carried).norm(dim=1))
            shared.append((posed(there, None)[0] - posed(here, None)[0] - carried).norm(dim=1))
    distance, own, shared = (float(torch.cat(each).mean()) for each in (distances, own, shared))
    assert distance < 0.03
    assert own < 0.85 * shared


def test_what_keeps_a_garment_in_one_piece(registered):
    _, avatar, _, _ = registered
    rest = RestOffsets(avatar, [("sway", 2), ("sway", 0), ("walk", 0)])
    config, garment = dataclasses.replace(TrainConfig().loss, spatial=0.0), avatar.garment_texels()
    means, fitted = avatar.template.means.data, avatar.template.means.detach().clone()
    with torch.no_grad():
        rest.offsets[1] = 0.01
        try:
            means.copy_(avatar.texel_positions)
            # One shape of three is a centimetre off along three axes.
            assert float(rest.loss(avatar, config)) == pytest.approx(PULL)
            means[garment] += 0.02
            assert float(rest.loss(avatar, config)) == pytest.approx(PULL), "moving together costs"
            means[garment[0]] += 0.02
            assert float(rest.loss(avatar, config)) > 1.001 * PULL
        finally:
            means.copy_(fitted)
    assert torch.equal(rest.earliest("sway"), torch.full_like(rest.offsets[1], 0.01))
    assert not rest.earliest("jumps").any()


def frames_with_map(maps: RegisteredMaps) -> set[int]:
    return {frame for frame in range(100) if maps.has_map(SEQUENCE, frame)}


def distance_to_cloth(capture, avatar, registration, maps) -> float:
    motion_window = avatar.driving_signal(capture.motions[SEQUENCE]).windows[[LAST]]
    points = registration._posed(motion_window, maps)
    cloth = torch.from_numpy(np.asarray(capture.garment(SEQUENCE)[LAST])).float()
    return float(torch.cdist(points, cloth).amin(1).mean())


def test_registered_maps_follow_the_cloth_into_a_spin(registered):
    capture, avatar, registration, _ = registered
    maps = registration.maps.offsets[SEQUENCE]
    assert frames_with_map(registration.maps) == set(range(4, LAST + 1))
    found = maps[LAST, avatar.garment_control_points()]
    assert found.norm(dim=1).mean() > 0.01
    before = distance_to_cloth(capture, avatar, registration, torch.zeros_like(found))
    assert distance_to_cloth(capture, avatar, registration, found) < 0.6 * before
    # The body is left alone.
    body = torch.ones(len(avatar.control.cells), dtype=torch.bool)
    body[avatar.garment_control_points()] = False
    assert (maps[:, body] == 0).all()


def test_cloth_that_no_camera_saw_stays_as_it_was_and_teaches_nothing(registered, monkeypatch):
    _, _, registration, _ = registered
    maps = registration.maps
    before, fitted = maps.offsets[SEQUENCE].clone(), maps.fitted[SEQUENCE].clone()
    monkeypatch.setattr(registration, "capture", SimpleNamespace(cameras_with_image=lambda name, frame: []))
    monkeypatch.setattr(maps, "unseen", {SEQUENCE: frozenset({LAST})})
    try:
        assert registration.fit(SEQUENCE, LAST) is None
        assert torch.equal(maps.offsets[SEQUENCE][LAST], before[LAST - 1])
        assert maps.fitted[SEQUENCE] == fitted + 1
        maps.fitted[SEQUENCE] = fitted
        assert frames_with_map(maps) == set(range(4, LAST))
    finally:
        maps.offsets[SEQUENCE], maps.fitted[SEQUENCE] = before, fitted


def test_registration_goes_on_where_it_was_interrupted(registered):
    _, _, registration, copy = registered
    assert torch.equal(registration.maps.offsets[SEQUENCE], copy.maps.offsets[SEQUENCE])
    assert frames_with_map(registration.maps) == frames_with_map(copy.maps)
    assert torch.equal(registration.rest.offsets, copy.rest.offsets)


def test_the_network_learns_to_follow_maps_that_lag_behind_the_motion(registered):
    capture, _, registration, _ = registered
    torch.manual_seed(0)
    config = TrainConfig()
    model = ModelConfig(
        channels=(8, 16, 16), window=3, memory=2, heads=2, mean_time_constants=(0.1, 0.2, 0.4), prior="none"
    )
    config = dataclasses.replace(config, model=model)
    small = Avatar.from_capture(capture, capture.body, config.atlas, model)
    state = TrainingState.begin(config, capture, small, {SEQUENCE: range(4, LAST + 1)}, [])
    state.registered = registration.maps
    signals = {SEQUENCE: small.driving_signal(capture.motions[SEQUENCE])}
    trainer = ChunkTrainer(config, KeptViews(capture), state, signals, None)
    gradients, losses = Gradients(list(small.parameters())), []
    for step in range(60):
        set_rates(state.optimizers, schedule_at(config.schedule, 0.13 + 0.15 * step / 60))
        gradients.clear()
        losses.append(trainer.backward_pretraining(np.random.default_rng([1, step])).loss)
        for optimizer in state.optimizers.values():
            optimizer.step()
    assert np.mean(losses[-10:]) < 0.5 * np.mean(losses[:10])


def test_work_is_shared_out_evenly():
    clips = {"a": range(100), "b": range(60), "c": range(50), "d": range(5, 15)}
    shares = divide_sequences(clips, 2)
    assert sorted(name for share in shares for name in share) == sorted(clips)
    assert sorted(sum(len(clips[name]) for name in share) for share in shares) == [110, 110]
    assert divide_sequences({}, 2) == [[], []]


def test_a_figure_without_a_garment_is_not_registered():
    torch.manual_seed(0)
    config, capture = TrainConfig(), open_capture()
    bare = dataclasses.replace(config.atlas, garment="off")
    avatar = Avatar.from_capture(capture, capture.body, bare, config.model)
    maps = RegisteredMaps.begin(config, capture, avatar, {SEQUENCE: range(9)})
    assert maps.complete
    assert not maps.clips
    assert not maps.usable
    assert without_pretraining(config.schedule).pretraining_fraction == 0


class ThreeFrames(Registration):
    """A registration whose frames are fitted at once."""

    def __init__(self):
        self.maps = RegisteredMaps({SEQUENCE: range(3)}, 1, {SEQUENCE: frozenset()})
        self.avatar = SimpleNamespace(unhide_covered_texels=lambda: None)

    def fit_next(self):
        self.maps.count += 1


@pytest.mark.parametrize("behind", [0.0, 0.01])
def test_workers_whose_clocks_differ_agree_on_the_time_that_registration_took(behind):
    """They would part at the end of a run, one of them waiting for ever."""
    registration = ThreeFrames()

    class Late(loop.Clock):
        def seconds(self):
            return 5.0 + registration.maps.count - behind

    class Shared(Gradients):
        def average(self, stop, seconds):
            return stop, 5.0 + registration.maps.count

    limit = TimeLimit(TrainConfig().schedule, used=2.0)
    assert not loop._register(
        registration, Shared([torch.nn.Parameter(torch.zeros(1))]), [], Late(), limit, 0.12, lambda *_: None
    )
    assert limit.seconds == 2.0 + 8.0


def test_frames_that_time_was_too_short_for_are_counted():
    registration = ThreeFrames()
    schedule = dataclasses.replace(TrainConfig().schedule, steps=1000, minutes=1.0)
    limit = TimeLimit(schedule, network_seconds=1.0)
    for update in range(1, 7):
        limit.note("template", 0.1 * update)

    class Slow(Gradients):
        def average(self, stop, seconds):
            return stop, 25.0 + registration.maps.count

    assert not loop._register(
        registration,
        Slow([torch.nn.Parameter(torch.zeros(1))]),
        [],
        loop.Clock(),
        limit,
        0.12,
        lambda *_: None,
    )
    assert registration.maps.complete
    assert registration.maps.unregistered == 3
