"""What a driving signal remembers of a motion."""

import math

import torch

from dsar.avatar.driving import DrivingSignal, find_jumps
from dsar.avatar.mirror import mirror_motion
from dsar.body.files import load_body
from dsar.body.skinning import forward_kinematics
from dsar.geometry.rotations import matrix_from_axis_angle

FPS, LAG = 30.0, 0.2
BODY = load_body()
PELVIS = BODY.joints[0]


def walk(frames: int, turn: float = 0.0, step: float = 0.0) -> torch.Tensor:
    """A stiff body that turns and walks steadily, after a first frame."""
    rotations = torch.zeros(frames, 55, 3)
    rotations[:, 0, 1] = turn * torch.arange(frames)
    translations = torch.zeros(frames, 3)
    translations[:, 2] = step * torch.arange(frames)
    return forward_kinematics(BODY, rotations, translations)


def windows_of(transforms: torch.Tensor, *arguments) -> torch.Tensor:
    return DrivingSignal.of_transforms(transforms, *arguments).windows


def test_the_mean_forgets_exponentially():
    transforms = walk(50, turn=0.1)
    windows = windows_of(transforms, PELVIS, FPS, (LAG,))
    assert torch.equal(windows[:, 0], transforms)
    # The same as a sum over the whole past, of which the first frame lasted forever.
    keep = math.exp(-1 / (LAG * FPS))
    weights = (1 - keep) * keep ** torch.arange(50.0).flip(0)
    weights[0] /= 1 - keep
    # The body stays in place, so that no root is to be moved.
    root = transforms[:, 0, :3, :3] @ PELVIS + transforms[:, 0, :3, 3]
    assert (root - root[0]).abs().max() < 1e-5
    expected = (weights[:, None, None, None] * transforms).sum(0)
    torch.testing.assert_close(windows[-1, 3], expected, atol=1e-5, rtol=0)


def test_a_steady_walk_does_not_lag_behind_itself_and_a_turn_does():
    straight = windows_of(walk(60, step=0.05), PELVIS, FPS, (LAG,))
    torch.testing.assert_close(straight[:, 3], straight[:, 0], atol=1e-5, rtol=0)
    turning = windows_of(walk(60, turn=0.2), PELVIS, FPS, (LAG,))
    hand = BODY.joints[20]
    now, lagged = (turning[-1, k, 20, :3, :3] @ hand + turning[-1, k, 20, :3, 3] for k in (0, 3))
    assert (now - lagged).norm() > 0.1
    # After the turn the lag dies away.
    still = torch.cat([walk(60, turn=0.2), walk(60, turn=0.2)[-1:].expand(60, -1, -1, -1)])
    after = windows_of(still, PELVIS, FPS, (LAG,))
    assert (after[-1, 3] - after[-1, 0]).abs().max() < 1e-3


def test_the_future_does_not_change_the_means():
    transforms = walk(20, turn=0.1)
    changed = transforms.clone()
    changed[12:] = walk(20, turn=-0.3)[12:]
    one, two = (windows_of(each, PELVIS, FPS, (0.1, LAG)) for each in (transforms, changed))
    assert torch.equal(one[:12], two[:12])
    assert not torch.equal(one[12], two[12])


def test_means_of_the_mirrored_motion_are_mirrored_means():
    transforms = forward_kinematics(BODY, 0.1 * torch.randn(15, 55, 3).cumsum(0), torch.randn(15, 3))
    # A pelvis on the mirror's plane, which that of the embedded body misses by a millimetre.
    pelvis = PELVIS * torch.tensor([0.0, 1.0, 1.0])
    one = mirror_motion(windows_of(transforms, pelvis, FPS, (LAG,)))
    torch.testing.assert_close(
        one, windows_of(mirror_motion(transforms), pelvis, FPS, (LAG,)), atol=1e-5, rtol=0
    )


def test_a_motion_window_holds_three_frames_and_the_newest_means():
    transforms = walk(6, turn=0.3)
    windows = windows_of(transforms, PELVIS, FPS, (0.1, LAG))
    assert windows.shape[:2] == (6, 5)
    assert torch.equal(windows[0, :3], transforms[[0, 0, 0]])
    assert torch.equal(windows[4, :3], transforms[[4, 3, 2]])
    assert windows_of(transforms, PELVIS, FPS, ()).shape[1] == 3


def test_a_past_jumps_with_its_body():
    steady = walk(30, turn=0.2, step=0.05)
    about = matrix_from_axis_angle(torch.tensor([0.0, 2.5, 0.0]))
    jump = torch.eye(4)
    jump[:3, :3], jump[:3, 3] = about, torch.tensor([7.0, 0.0, -3.0])
    broken = torch.cat([steady[:12], jump @ steady[12:]])
    broken[20:] = jump @ broken[20:]
    assert find_jumps(steady, PELVIS, FPS) == []
    assert find_jumps(broken, PELVIS, FPS) == [12, 20]
    one, other = (windows_of(each, PELVIS, FPS, (0.1, LAG)) for each in (steady, broken))
    assert torch.equal(one[:12], other[:12])
    torch.testing.assert_close(other[:, 0], broken, atol=1e-4, rtol=0)
    # What a step sees differs by where the body stands and which way it faces, and by nothing else.
    torch.testing.assert_close(jump @ one[12:20], other[12:20], atol=1e-4, rtol=0)
    torch.testing.assert_close(jump @ jump @ one[20:], other[20:], atol=1e-4, rtol=0)


def test_a_body_that_faces_the_other_way_at_once_has_jumped_and_a_pirouette_has_not():
    # Four turns a second are more than a skater's.
    assert find_jumps(walk(30, turn=8 * math.pi / FPS), PELVIS, FPS) == []
    flipped = torch.cat([walk(12), walk(2, turn=math.pi)[1:], walk(12)])
    assert find_jumps(flipped, PELVIS, FPS) == [12, 13]
