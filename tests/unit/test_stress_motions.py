"""Motions that are made are what they say: on the ground, of the poses named, filled and shaken as told."""

import math

import pytest
import torch

from dsar.body.files import load_body
from dsar.body.model import JOINT_NAMES
from dsar.body.skinning import forward_kinematics, pose_vertices
from dsar.evaluation.stress import poses
from dsar.evaluation.stress.motions import (
    Key,
    fastest_gap,
    fill_gap,
    play_keys,
    scale_motion,
    shake_joints,
    spin_and_stop,
    wander_poses,
)
from dsar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from tests.loose_cloth import FPS, striding

BODY = load_body()


def turned_between(one, other):
    """Return the angles between rotations, radians."""
    return axis_angle_from_matrix(matrix_from_axis_angle(one).mT @ matrix_from_axis_angle(other)).norm(dim=-1)


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_keys_are_reached_held_and_stand_on_the_ground(heading):
    walk = striding(3, 0, "walk")
    walk.rotations[:, 0, 1] = heading
    keys = (
        Key(0.5, {"left_knee": (90.0, 0.0, 0.0)}, hold=0.2),
        Key(0.3, turn=(-90.0, 0.0, 0.0), hold=0.1),
        Key(0.2, lift=0.4),
    )
    made = play_keys(walk, BODY, keys, "made")
    assert len(made) == 1 + 15 + 6 + 9 + 3 + 6
    knee = JOINT_NAMES.index("left_knee")
    assert made.rotations[21, knee, 0] == pytest.approx(math.pi / 2, rel=1e-5)
    assert torch.equal(made.rotations[15:22], made.rotations[21:22].expand(7, -1, -1))
    torch.testing.assert_close(made.rotations[0], walk.rotations[0], atol=1e-5, rtol=0)
    for frame, lift in ((0, 0.0), (21, 0.0), (33, 0.0), (39, 0.4)):
        assert pose_vertices(BODY, made[frame])[:, 1].min() == pytest.approx(lift, abs=0.01)
    # On its back: what was ahead is up, whichever way it faced; its head is behind.
    turn = matrix_from_axis_angle(made.rotations[33, 0])
    ahead = torch.tensor([math.sin(heading), 0.0, math.cos(heading)])
    torch.testing.assert_close(
        turn @ torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 1.0, 0.0]), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(turn @ torch.tensor([0.0, 1.0, 0.0]), -ahead, atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", ["CONTACT", "SHEAR", "FLOOR", "EXTREME"])
def test_made_motions_end_upright_and_never_move_faster_than_a_cut(name):
    made = play_keys(striding(2, 0, "walk"), BODY, getattr(poses, name), name)
    transforms = forward_kinematics(BODY, made.rotations, made.translations)
    up = transforms[:, 0, :3, 1]
    assert up[-1, 1] == pytest.approx(1, abs=1e-3)
    if name == "FLOOR":
        assert up[:, 1].min() < 0.05, "it lies"
        assert up[:, 1].min() > -0.2, "it never stands on its head"
    assert turned_between(made.rotations[:-1, 0], made.rotations[1:, 0]).max() < 1.0
    pelvis = (transforms[:, 0, :3, :3] @ BODY.joints[0]) + transforms[:, 0, :3, 3]
    assert pelvis.diff(dim=0).norm(dim=-1).max() * FPS < 6


def test_lost_frames_are_filled_between_those_around_them():
    walk = striding(40, 1, "walk")
    filled = fill_gap(walk, 10, 5)
    assert torch.equal(filled.rotations[:10], walk.rotations[:10])
    torch.testing.assert_close(filled.rotations[15:], walk.rotations[15:])
    steps = turned_between(filled.rotations[9:15], filled.rotations[10:16])
    torch.testing.assert_close(steps, steps[:1].expand_as(steps), atol=1e-4, rtol=0)
    torch.testing.assert_close(filled.translations[12], walk.translations[9].lerp(walk.translations[15], 0.5))
    assert not torch.equal(filled.rotations[12], walk.rotations[12])


def test_a_gap_is_where_the_body_is_fastest_but_could_be_filled():
    still = striding(3, 0, "walk")
    spin, stop = spin_and_stop(still, speed=3.0)
    assert 15 <= fastest_gap(spin, 2) <= stop
    # 12 radians a second are more than half a turn in 11 frames, and the ends look near again.
    fast, stop = spin_and_stop(still, speed=12.0)
    start = fastest_gap(fast, 10)
    way = turned_between(fast.rotations[:-1, 0], fast.rotations[1:, 0])[start - 1 : start + 10].sum()
    assert 1.0 < way < math.radians(150)


def test_noise_turns_each_joint_by_as_much_as_it_says():
    walk = striding(200, 1, "walk")
    shaken = shake_joints(walk, 1.0, torch.Generator().manual_seed(0))
    angles = turned_between(walk.rotations[:, :22], shaken.rotations[:, :22])
    assert angles.square().mean().sqrt() == pytest.approx(math.radians(1) * 3**0.5, rel=0.05)
    assert torch.equal(walk.rotations[:, 22:], shaken.rotations[:, 22:])


def test_poses_wander_in_the_motion_s_own_directions_as_far_as_it_says():
    walk = striding(120, 1, "walk")
    flat = walk.rotations[:, 1:22].flatten(1)
    for sigmas in (1.0, 4.0):
        made = wander_poses(walk, sigmas)
        away = made.rotations[:, 1:22].flatten(1) - flat.mean(0)
        axes = torch.linalg.svd(flat - flat.mean(0), full_matrices=False)
        spread = axes.S[0] / len(flat) ** 0.5
        assert (away @ axes.Vh[0]).abs().max() == pytest.approx(sigmas * float(spread), rel=0.05)
        assert away[0].abs().max() < 1e-6
    # Whatever is not a direction of the motion stays as it is.
    assert (away - away @ axes.Vh.T @ axes.Vh).abs().max() < 1e-5


def test_a_larger_person_s_steps_and_hips_are_larger():
    walk = striding(40, 1, "walk")
    large = scale_motion(walk, BODY, 1.25)
    hips = [motion.translations + BODY.joints[0] for motion in (walk, large)]
    torch.testing.assert_close(hips[1], 1.25 * hips[0])
    assert torch.equal(large.rotations, walk.rotations)
