"""Choreography: the packed motions are the authored ones, feet stand still, legs reach, pieces keep apart."""

import numpy as np
import pytest
import torch
from capture.choreography import FPS, MOCAP, choreograph
from capture.gait import plan_steps
from capture.posing import Score, compose_motion
from capture.unseen import AUTHORED, PIECES, choreograph_unseen

from dsar.body.files import load_body
from dsar.body.skinning import forward_kinematics
from dsar.data.captures.formats import EMBEDDED_CAPTURE, open_capture
from dsar.data.motions.files import write_motion

CLIPS = EMBEDDED_CAPTURE.parent / "embedded_motion"
SEED = 7
ANKLES = [7, 8]


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def unseen(body):
    return choreograph_unseen(body, CLIPS, SEED)


def places(body, motion, joints):
    transforms = forward_kinematics(body, motion.rotations, motion.translations)[:, joints]
    return (
        (transforms[..., :3, :3] @ body.joints[joints][..., None])[..., 0] + transforms[..., :3, 3]
    ).numpy()


def walk(frames, speed, turn):
    """A phase of a cycle a second, a path and a heading that ends turned."""
    t = np.arange(frames) / FPS
    heading = turn * t / t[-1]
    path = np.cumsum(speed / FPS * np.stack([np.sin(heading), np.cos(heading)], -1), 0)
    return 0.06 + t, path, heading


def test_the_motions_in_the_package_are_the_authored_ones(body, unseen, tmp_path):
    seen, _ = choreograph(body, CLIPS, SEED)
    assert not set(seen) & set(unseen)
    for name, take in {**seen, **unseen}.items():
        write_motion(tmp_path / "motion.npz", take.motion, body)
        kept = EMBEDDED_CAPTURE / "motion" / f"{name}.npz"
        with np.load(tmp_path / "motion.npz") as made, np.load(kept) as packed:
            np.testing.assert_allclose(made["poses"], packed["poses"], atol=1e-5, err_msg=name)
            np.testing.assert_allclose(made["trans"], packed["trans"], atol=1e-5, err_msg=name)


def test_the_capture_has_every_unseen_motion_in_its_half(unseen):
    splits = open_capture().splits
    for split in ("unseen_validation", "unseen_test"):
        assert set(splits[split]) == {name for name, take in unseen.items() if take.split == split}
    assert len(unseen) == len(PIECES) + len(AUTHORED) >= 16


def test_pieces_of_motion_capture_keep_a_second_from_what_trains_and_tests():
    for clip, first, frames, _ in PIECES.values():
        for other, start, length, *_ in MOCAP.values():
            assert clip != other or first - (start + length) >= FPS or start - (first + frames) >= FPS


def test_no_pose_of_one_half_or_of_training_is_in_the_other():
    capture = open_capture()
    groups = [
        torch.cat([capture.motions[name].rotations[:, 1:].flatten(1) for name in names])
        for names in (
            capture.splits["unseen_validation"],
            capture.splits["unseen_test"],
            (*capture.splits["train"], *capture.splits["test"]),
        )
    ]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert float(torch.cdist(groups[a], groups[b]).min()) > 0.02


@pytest.mark.parametrize("turn", [0.0, 1.2])
def test_a_standing_foot_stays_where_it_is_and_a_swinging_one_overtakes_it(turn):
    phase, path, heading = walk(90, 1.2, turn)
    feet = plan_steps(phase, path, heading, effort=np.ones(90))
    for side in (0, 1):
        u = (phase + 0.5 * side) % 1
        flat = (u > 0.1) & (u < 0.35)
        runs = np.split(np.flatnonzero(flat), np.flatnonzero(np.diff(np.flatnonzero(flat)) > 1) + 1)
        for run in runs:
            assert np.ptp(feet.place[run, side], axis=0).max() < 1e-6
            assert np.ptp(feet.yaw[run, side]) < 1e-6
        landings = [feet.place[run[0], side, [0, 2]] for run in runs[1:]]
        strides = np.linalg.norm(np.diff(landings, axis=0), axis=1)
        np.testing.assert_allclose(strides, 1.2, rtol=0.12)
        assert 0.04 < feet.place[:, side, 1].max() < 0.15
        assert feet.place[:, side, 1].min() > -1e-9


def test_a_path_turned_in_the_plane_turns_the_feet(body):
    phase, path, heading = walk(60, 1.1, 0.5)
    effort = np.ones(60)
    straight = plan_steps(phase, path, heading, effort=effort)
    c, s = np.cos(0.9), np.sin(0.9)
    turned = plan_steps(phase, path @ np.array([[c, -s], [s, c]]), heading + 0.9, effort=effort)
    x, y, z = np.moveaxis(straight.place, -1, 0)
    np.testing.assert_allclose(turned.place, np.stack([c * x + s * z, y, c * z - s * x], -1), atol=1e-12)
    np.testing.assert_allclose(turned.yaw, straight.yaw + 0.9, atol=1e-12)


def test_legs_reach_the_feet_of_every_authored_walk(body):
    joints, ground = body.joints.double().numpy(), float(body.vertices[:, 1].min())
    for name, (_, author) in AUTHORED.items():
        curves = author(np.random.default_rng([SEED, *name.encode()]))
        if curves.get("feet") is None:
            continue
        motion = compose_motion(Score(**curves), joints, ground, FPS, name)
        wanted = curves["feet"].place + np.array([0.0, joints[7, 1] - ground, 0.0])
        distance = np.linalg.norm(places(body, motion, ANKLES) - wanted, axis=-1)
        assert distance.max() < 0.02, name


def test_authored_bodies_stay_on_the_ground_and_in_reach_of_people(body, unseen):
    for name in AUTHORED:
        motion = unseen[name].motion
        ankles = places(body, motion, ANKLES)
        assert ankles[..., 1].min() > 0.02, name
        assert np.linalg.norm(np.diff(ankles, axis=0), axis=-1).max() * FPS < 10.0, name
        assert 60 <= len(motion) <= 150
