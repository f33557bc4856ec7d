"""Skinning against a plain loop and against another library reading the same file."""

import numpy as np
import pytest
import torch

from dsar.body.files import EMBEDDED_BODY, load_body
from dsar.body.model import FACE_JOINTS, JOINT_NAMES
from dsar.body.skinning import blend_transforms, forward_kinematics, pose_vertices, skin_points
from dsar.types import Body, Pose


@pytest.fixture(scope="module")
def body() -> Body:
    return load_body()


def random_pose(seed: int, dtype: torch.dtype = torch.float32) -> Pose:
    generator = torch.Generator().manual_seed(seed)
    rotations = 0.6 * torch.randn(len(JOINT_NAMES), 3, generator=generator, dtype=dtype)
    return Pose(rotations, torch.randn(3, generator=generator, dtype=dtype))


def rodrigues(vector: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def test_vertices_equal_a_loop_over_joints_in_float64(body: Body) -> None:
    precise, pose = body.to(dtype=torch.float64), random_pose(0, torch.float64)
    joints, rotations = precise.joints.numpy(), pose.rotations.numpy()
    turns, heads = [rodrigues(rotations[0])], [joints[0]]
    for j in range(1, len(joints)):
        parent = body.parents[j]
        turns.append(turns[parent] @ rodrigues(rotations[j]))
        heads.append(heads[parent] + turns[parent] @ (joints[j] - joints[parent]))
    expected = np.zeros((len(body.vertices), 3))
    for j, weight in enumerate(precise.weights.numpy().T):
        moved = (precise.vertices.numpy() - joints[j]) @ turns[j].T + heads[j]
        expected += weight[:, None] * (moved + pose.translation.numpy())
    np.testing.assert_allclose(pose_vertices(precise, pose).numpy(), expected, atol=1e-12)


def test_body_models_reads_the_embedded_file_and_poses_it_the_same(body: Body) -> None:
    smplx = pytest.importorskip("body_models.smplx.torch")
    other = smplx.SMPLX(model_path=EMBEDDED_BODY, flat_hand_mean=True)
    pose, betas = random_pose(1), torch.linspace(-1, 1, 10)
    face, hands = FACE_JOINTS.start, FACE_JOINTS.stop
    expected = other.forward_vertices(
        pose.rotations[None, 1:face],
        pose.rotations[None, face:hands],
        pose.rotations[None, hands:],
        pelvis_rotation=pose.rotations[:1],
        shape=betas[None],
        expression=torch.zeros(1, 10),
        global_translation=pose.translation[None],
    )[0]
    assert (pose_vertices(load_body(betas=betas), pose) - expected).abs().max() < 1e-5


def test_kinematics_of_a_batch_are_those_of_each_pose(body: Body) -> None:
    poses = [random_pose(seed) for seed in range(3)]
    batch = forward_kinematics(
        body, torch.stack([p.rotations for p in poses]), torch.stack([p.translation for p in poses])
    )
    for pose, transforms in zip(poses, batch, strict=True):
        assert torch.allclose(
            forward_kinematics(body, pose.rotations, pose.translation), transforms, atol=1e-6
        )


def test_a_point_that_hangs_on_one_joint_moves_rigidly_with_it(body: Body) -> None:
    pose = random_pose(2)
    transforms = forward_kinematics(body, pose.rotations, pose.translation)
    elbow = JOINT_NAMES.index("left_elbow")
    weights = torch.nn.functional.one_hot(torch.tensor([elbow]), len(JOINT_NAMES)).float()
    assert torch.equal(blend_transforms(weights, transforms)[0], transforms[elbow, :3])
    point = body.joints[elbow : elbow + 1]
    expected = transforms[elbow] @ torch.cat([point[0], torch.ones(1)])
    assert torch.allclose(skin_points(point, weights, transforms)[0], expected[:3], atol=1e-6)


def test_gradients_reach_pose_translation_and_points(body: Body) -> None:
    precise, pose = body.to(dtype=torch.float64), random_pose(3, torch.float64)
    rows = torch.tensor([0, 9000])

    def posed(rotations: torch.Tensor, translation: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        transforms = forward_kinematics(precise, rotations, translation)
        return skin_points(points, precise.weights[rows], transforms)

    inputs = [t.clone().requires_grad_() for t in (pose.rotations, pose.translation, precise.vertices[rows])]
    assert torch.autograd.gradcheck(posed, inputs, fast_mode=True)


def test_gradient_at_the_rest_pose_is_finite(body: Body) -> None:
    rotations = torch.zeros(len(JOINT_NAMES), 3, requires_grad=True)
    pose_vertices(body, Pose(rotations, torch.zeros(3))).square().sum().backward()
    assert rotations.grad is not None
    assert bool(rotations.grad.isfinite().all())
    assert rotations.grad.abs().max() > 0
