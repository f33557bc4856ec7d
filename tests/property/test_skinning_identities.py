"""What skinning keeps, whatever the pose."""

import dataclasses

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dsar.body.files import load_body
from dsar.body.model import JOINT_NAMES, PARENTS
from dsar.body.skinning import forward_kinematics, pose_vertices
from dsar.data.motions.files import rotate_motion
from dsar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from dsar.types import Motion, Pose

BODY = load_body().to(dtype=torch.float64)
# Rows of float32 weights sum to 1 only to float32's precision.
BODY = dataclasses.replace(BODY, weights=BODY.weights / BODY.weights.sum(1, keepdim=True))
SMALL = dataclasses.replace(BODY, vertices=BODY.vertices[::40], weights=BODY.weights[::40])

seeds = st.integers(0, 2**31)


def random_pose(seed: int) -> Pose:
    generator = torch.Generator().manual_seed(seed)
    rotations = torch.randn(len(JOINT_NAMES), 3, generator=generator, dtype=torch.float64)
    return Pose(rotations, torch.randn(3, generator=generator, dtype=torch.float64))


def test_zero_pose_is_the_rest_mesh() -> None:
    pose = Pose(torch.zeros(len(JOINT_NAMES), 3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    assert torch.allclose(pose_vertices(BODY, pose), BODY.vertices, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(seed=seeds)
def test_pelvis_and_translation_move_the_posed_body_rigidly_about_the_pelvis(seed: int) -> None:
    pose, other = random_pose(seed), random_pose(seed + 1)
    still = dataclasses.replace(
        pose,
        rotations=pose.rotations.index_fill(0, torch.tensor(0), 0),
        translation=torch.zeros_like(pose.translation),
    )
    moved = dataclasses.replace(
        pose,
        rotations=torch.cat([other.rotations[:1], pose.rotations[1:]]),
        translation=other.translation,
    )
    turn, pelvis = matrix_from_axis_angle(other.rotations[0]), BODY.joints[0]
    expected = (pose_vertices(SMALL, still) - pelvis) @ turn.T + pelvis + other.translation
    assert torch.allclose(pose_vertices(SMALL, moved), expected, atol=1e-11)


@settings(max_examples=20, deadline=None)
@given(seed=seeds)
def test_bones_keep_their_length_and_joints_their_right_angles(seed: int) -> None:
    pose = random_pose(seed)
    transforms = forward_kinematics(BODY, pose.rotations, pose.translation)
    heads = (transforms[:, :3, :3] @ BODY.joints[:, :, None]).squeeze(-1) + transforms[:, :3, 3]
    parents = list(PARENTS[1:])
    lengths = (heads[1:] - heads[parents]).norm(dim=1)
    assert torch.allclose(lengths, (BODY.joints[1:] - BODY.joints[parents]).norm(dim=1), atol=1e-11)
    identity = torch.eye(3, dtype=torch.float64).expand(len(JOINT_NAMES), 3, 3)
    assert torch.allclose(transforms[:, :3, :3] @ transforms[:, :3, :3].mT, identity, atol=1e-11)


@settings(max_examples=20, deadline=None)
@given(seed=seeds, angle=st.floats(-3.1, 3.1))
def test_turning_a_motion_turns_its_vertices_about_the_world_origin(seed: int, angle: float) -> None:
    pose = random_pose(seed)
    turn = matrix_from_axis_angle(torch.tensor([0.0, angle, 0.0], dtype=torch.float64))
    motion = Motion(pose.rotations[None], pose.translation[None], 30.0)
    turned = rotate_motion(motion, BODY, turn)
    expected = pose_vertices(SMALL, pose) @ turn.T
    assert torch.allclose(pose_vertices(SMALL, turned[0]), expected, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(seed=seeds)
def test_rotations_that_differ_by_a_full_turn_pose_the_same(seed: int) -> None:
    pose = random_pose(seed)
    shorter = axis_angle_from_matrix(matrix_from_axis_angle(pose.rotations))
    same = dataclasses.replace(pose, rotations=shorter)
    assert torch.allclose(pose_vertices(SMALL, same), pose_vertices(SMALL, pose), atol=1e-9)
