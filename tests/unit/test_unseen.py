"""The error on unseen motions, on garments whose error is known."""

import dataclasses

import numpy as np
import pytest
import torch

from dsar.avatar.rollout import network_outputs, roll_out
from dsar.data.motions.files import rotate_motion
from dsar.errors import CaptureError
from dsar.evaluation import garment_tracking, unseen
from dsar.evaluation.garment_tracking import TrackedGarment, track_garment
from dsar.evaluation.results import UnseenMotion
from dsar.evaluation.unseen import (
    describe_unseen,
    free_points,
    measure_motions,
    measure_unseen,
    roll_out_points,
    summarize_motions,
    unseen_missing,
)
from dsar.network import STREAMS, NetworkOutput
from tests.loose_cloth import capture_of, heading, skirt_avatar, striding

EXACT = 0.3
"""Millimetres that a point, which rides on four texels, may be off one of them."""
SPLITS = {"train": ("one", "two"), "unseen_validation": ("leap",), "unseen_test": ("dance",)}


@pytest.fixture(scope="module")
def avatar():
    return skirt_avatar()


@pytest.fixture(scope="module")
def lively():
    """An avatar whose network does something."""
    made = skirt_avatar()
    torch.nn.init.normal_(made.network.decoder.head.weight, std=0.05)
    return made


@pytest.fixture(scope="module")
def motions():
    return {name: striding(40, seed, name) for seed, name in enumerate(("one", "two", "leap", "dance"))}


def garments_of(avatar, motions):
    """Return every third texel of the garment, as the avatar rolls it out."""
    chosen = avatar.garment_texels()[::3]
    return {
        name: torch.stack([gaussians.means[chosen].detach() for _, gaussians in roll_out(avatar, motion)])
        for name, motion in motions.items()
    }


def with_second_runs(garments, second):
    """Return a second run of all but training, in which the first third of the points is held."""
    runs = {}
    for name, garment in garments.items():
        other = garment.clone()
        other[:, len(other[0]) // 3 :] += second
        runs[name] = [garment] if name in SPLITS["train"] else [garment, other]
    return runs


@pytest.fixture
def pretend(monkeypatch):
    """Return a function that puts offsets (metres, by motion and frame) in the place of the network's."""

    def put(offset):
        def outputs(avatar, motion, *, streams=STREAMS):
            windows = avatar.driving_signal(motion).windows
            for frame in range(len(motion)):
                value = torch.tensor(offset(motion.name, frame))[:, None, None]
                maps = value.expand(1, 3, *avatar.control.size).clone()
                yield windows[[frame]], NetworkOutput(maps, torch.zeros(1, 11, *avatar.control.size), ())

        for module in (garment_tracking, unseen):
            monkeypatch.setattr(module, "network_outputs", outputs)

    return put


def test_a_garment_that_moves_as_the_template_has_no_error(avatar, motions, tmp_path):
    capture = capture_of(
        tmp_path, avatar, motions, with_second_runs(garments_of(avatar, motions), 0.025), SPLITS
    )
    for name, figures in measure_unseen(avatar, capture).items():
        (motion,) = figures.motions.values()
        assert list(figures.motions) == list(SPLITS[f"unseen_{name}"])
        assert motion.mm == motion.mm_template == pytest.approx(0, abs=EXACT)
        # 25 mm along each of three axes.
        assert motion.mm_second == pytest.approx(25 * 3**0.5, abs=0.1)
        assert motion.frames == 40


def test_points_that_the_body_holds_are_left_out(avatar, motions, tmp_path):
    garments = garments_of(avatar, motions)
    count = garments["leap"].shape[1]
    capture = capture_of(tmp_path, avatar, motions, with_second_runs(garments, 0.01), SPLITS)
    assert free_points(capture).tolist() == list(range(count // 3, count))
    garments["leap"][:, : count // 3] += 0.2
    capture = capture_of(tmp_path, avatar, motions, with_second_runs(garments, 0.01), SPLITS)
    assert measure_motions(avatar, capture, ["leap"])["leap"].mm < EXACT
    alone = {name: [garment] for name, garment in garments.items()}
    capture = capture_of(tmp_path, avatar, motions, alone, SPLITS)
    assert len(free_points(capture)) == count, "without a second run nothing can be told"
    found = measure_motions(avatar, capture, ["leap"])["leap"]
    assert found.mm == pytest.approx(200 * 3**0.5 * ((count // 3) / count) ** 0.5, rel=1e-3)
    assert found.mm_second is None
    twins = {name: [garment, garment] for name, garment in garments.items()}
    assert len(free_points(capture_of(tmp_path, avatar, motions, twins, SPLITS))) == count


def test_a_garment_that_is_off_is_off_by_so_many_millimetres(avatar, motions, tmp_path):
    garments = garments_of(avatar, motions)
    garments["leap"] += torch.tensor([0.0, 0.012, 0.016])
    garments["dance"][:10] += torch.tensor([0.06, 0.0, 0.0])
    runs = {name: [garment] for name, garment in garments.items()}
    figures = measure_unseen(avatar, capture_of(tmp_path, avatar, motions, runs, SPLITS))
    leap, dance = figures["validation"].motions["leap"], figures["test"].motions["dance"]
    assert leap.mm == leap.mm_template == pytest.approx(20, abs=EXACT)
    # A quarter of the frames, root mean square.
    assert dance.mm == pytest.approx(30, abs=EXACT)
    assert figures["test"].ratio == 1


@pytest.mark.parametrize("axes", ["surface", "body"])
def test_what_the_network_adds_at_rest_is_the_garments_shape_and_no_error(axes, motions, tmp_path, pretend):
    avatar = skirt_avatar(axes)
    runs = {name: [garment] for name, garment in garments_of(avatar, motions).items()}
    capture = capture_of(tmp_path, avatar, motions, runs, SPLITS)
    pretend(lambda name, frame: [0.0, 0.01, 0.0])
    assert measure_motions(avatar, capture, ["leap"])["leap"].mm < EXACT
    pretend(lambda name, frame: [0.0, 0.01, 0.0] if name in SPLITS["train"] else [0.0, 0.01, 0.03])
    moved = measure_motions(avatar, capture, ["leap"])["leap"]
    assert moved.mm == pytest.approx(30, rel=0.03)
    assert moved.mm_template < EXACT


def test_a_network_that_is_right_has_no_error(lively, motions, tmp_path):
    runs = {name: [garment] for name, garment in garments_of(lively, motions).items()}
    capture = capture_of(tmp_path, lively, motions, runs, SPLITS)
    figures = measure_unseen(lively, capture)["validation"]
    assert figures.mm_template > 3
    assert figures.ratio < 0.1


def test_points_on_one_texel_each_are_those_of_the_gaussians(lively, motions, tmp_path):
    garment = lively.garment_texels()
    means, weights = lively.template.means.detach()[garment], lively.texel_weights[garment]
    shares = torch.ones(len(garment), 1)
    tracked = TrackedGarment(means, weights, garment[:, None], shares, torch.zeros_like(means))
    capture = capture_of(tmp_path, lively, motions, {}, SPLITS)
    predicted, template, transforms = roll_out_points(lively, capture, "leap", tracked, STREAMS)
    signal = lively.driving_signal(motions["leap"])
    assert torch.equal(transforms, signal.transforms)
    for frame, (_, gaussians) in enumerate(roll_out(lively, motions["leap"])):
        assert torch.allclose(predicted[frame], gaussians.means[garment], atol=2e-6)
        bare = lively.gaussians(signal.windows[[frame]], None)[0]
        assert torch.allclose(template[frame], bare.means[garment], atol=2e-6)
    assert (predicted - template).norm(dim=-1).max() > 0.01


def test_figures_do_not_depend_on_where_the_world_lies(lively, avatar, motions, tmp_path):
    turn, shift = heading(1.3), torch.tensor([0.4, 0.0, -0.3])
    garments = {name: [garment] for name, garment in garments_of(avatar, motions).items()}
    here = measure_unseen(lively, capture_of(tmp_path, lively, motions, garments, SPLITS))
    moved = {name: [garment @ turn.T + shift for garment in runs] for name, runs in garments.items()}
    turned = {}
    for name, motion in motions.items():
        about = rotate_motion(motion, lively.body, turn)
        turned[name] = dataclasses.replace(about, translations=about.translations + shift)
    there = measure_unseen(lively, capture_of(tmp_path, lively, turned, moved, SPLITS))
    for split, figures in here.items():
        assert figures.mm > 3
        assert there[split].mm == pytest.approx(figures.mm, abs=0.05)
        assert there[split].mm_template == pytest.approx(figures.mm_template, abs=0.05)


def test_what_comes_later_changes_nothing_before(lively, avatar, motions, tmp_path):
    garments = {name: [garment] for name, garment in garments_of(avatar, motions).items()}
    capture = capture_of(tmp_path, lively, motions, garments, SPLITS)
    tracked = track_garment(lively, capture)
    whole = roll_out_points(lively, capture, "leap", tracked, STREAMS)[0]
    cut = dataclasses.replace(capture, motions=motions | {"leap": motions["leap"].slice(0, 25)})
    assert torch.equal(roll_out_points(lively, cut, "leap", tracked, STREAMS)[0], whole[:25])
    short = measure_motions(lively, cut, ["leap"])["leap"]
    apart = (whole[:25] - garments["leap"][0][:25]).square().sum(-1).mean().sqrt()
    assert short.frames == 25
    assert short.mm == pytest.approx(1000 * float(apart), abs=0.05)


def test_the_network_runs_without_a_stream_where_it_is_asked_to(lively, motions, tmp_path):
    runs = {name: [garment] for name, garment in garments_of(lively, motions).items()}
    capture = capture_of(tmp_path, lively, motions, runs, SPLITS)
    whole, without = (measure_unseen(lively, capture, streams)["test"].mm for streams in (STREAMS, ()))
    assert without > 2 * whole
    outputs = list(network_outputs(lively, motions["dance"], streams=()))
    assert len(outputs) == 40


def figures_of(*errors):
    return summarize_motions({f"m{k}": UnseenMotion(*each, 10, ()) for k, each in enumerate(errors)})


def test_the_ratio_is_of_means_and_lies_in_its_interval():
    figures = figures_of((10.0, 100.0, 5.0), (90.0, 100.0, None), (60.0, 80.0, 7.0))
    assert figures.ratio == pytest.approx(160 / 280)
    assert (figures.mm, figures.mm_template, figures.mm_second) == pytest.approx((160 / 3, 280 / 3, 6))
    low, high = figures.ratio_ci
    # With three motions one draw in 27 has the same motion thrice: the ends are the extremes.
    assert (low, high) == pytest.approx((0.1, 0.9))
    assert figures == figures_of((10.0, 100.0, 5.0), (90.0, 100.0, None), (60.0, 80.0, 7.0))
    assert describe_unseen("test", figures).startswith("unseen test: 53.3 mm, template 93.3, ")


def test_the_interval_narrows_with_motions_as_it_should():
    rng = np.random.default_rng(1)
    errors = [(float(x), 100.0, None) for x in rng.normal(60, 10, 64)]
    low, high = figures_of(*errors).ratio_ci
    assert high - low == pytest.approx(2 * 1.96 * np.std([x for x, _, _ in errors]) / 100 / 8, rel=0.1)
    alone = figures_of(errors[0])
    assert alone.ratio_ci == (alone.ratio, alone.ratio)
    assert alone.mm_second is None


def test_what_is_missing_is_named(avatar, motions, tmp_path):
    garments = garments_of(avatar, motions)
    runs = {name: [garment] for name, garment in garments.items()}
    whole = capture_of(tmp_path, avatar, motions, runs, SPLITS)
    assert unseen_missing(avatar, whole) is None
    assert "no unseen motions" in unseen_missing(avatar, capture_of(tmp_path, avatar, motions, runs, {}))
    bare = {name: runs[name] for name in ("leap", "dance")}
    without = capture_of(tmp_path, avatar, motions, bare, SPLITS)
    assert "training" in unseen_missing(avatar, without)
    with pytest.raises(CaptureError, match="no training sequence"):
        measure_unseen(avatar, without)
    other = capture_of(tmp_path, avatar, motions, runs | {"leap": [garments["leap"][:, 1:]]}, SPLITS)
    with pytest.raises(CaptureError, match="as many points"):
        measure_unseen(avatar, other)
    only = capture_of(tmp_path, avatar, motions, runs, {"train": ("one",), "unseen_test": ("dance",)})
    assert list(measure_unseen(avatar, only)) == ["test"]
