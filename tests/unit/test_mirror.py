"""The mirror: against forward kinematics of a motion that was mirrored joint by joint."""

import torch

from dsar.avatar.avatar import Avatar
from dsar.avatar.charts import Atlas, body_chart
from dsar.avatar.mirror import Mirror, mirror_motion
from dsar.body.files import load_body
from dsar.body.model import JOINT_NAMES
from dsar.body.skinning import forward_kinematics
from dsar.config import ModelConfig
from dsar.network import NetworkOutput

FLIP = torch.tensor([-1.0, 1.0, 1.0])


def counterpart(name: str) -> str:
    if "left" in name:
        return name.replace("left", "right")
    return name.replace("right", "left")


def bare_avatar() -> Avatar:
    torch.manual_seed(0)
    body = load_body()
    return Avatar(body, Atlas.stack([body_chart(body, 64)]), ModelConfig(channels=(4, 8), upsample=2), 30.0)


def mirror_of(avatar: Avatar) -> Mirror:
    return Mirror(avatar.control)


def test_a_mirrored_motion_is_that_of_the_mirrored_joint_angles():
    body = load_body()
    generator = torch.Generator().manual_seed(0)
    rotations = 0.3 * torch.randn(4, 55, 3, generator=generator)
    translations = torch.randn(4, 3, generator=generator)
    order = [JOINT_NAMES.index(counterpart(name)) for name in JOINT_NAMES]
    # An axis of rotation is a pseudovector: its component across the mirror stays, the others turn.
    angles = rotations[:, order] * -FLIP
    there = forward_kinematics(body, angles, translations * FLIP)
    mirrored = mirror_motion(forward_kinematics(body, rotations, translations))
    torch.testing.assert_close(mirrored[..., :3, :3], there[..., :3, :3], atol=1e-4, rtol=0)
    # The embedded body's own joints are symmetric to a centimetre only, and errors add up to the fingers.
    assert (mirrored[..., :3, 3] - there[..., :3, 3]).norm(dim=-1).max() < 0.08
    torch.testing.assert_close(mirror_motion(mirrored), forward_kinematics(body, rotations, translations))


def test_mirrored_offsets_displace_the_mirrored_points():
    avatar = bare_avatar()
    h, w = avatar.control.size
    offset = torch.zeros(1, 3, h * w)
    points = avatar.control.points
    # A displacement that is smooth in space: up on the left, backwards on the right, outwards at the head.
    world = torch.stack([points[:, 0] * points[:, 1], points[:, 0] * 0.3, -points[:, 0] * 0.2], -1)
    offset[0, :, avatar.control.cells] = (avatar.control.axes.mT @ world[..., None])[..., 0].T
    mirrored = mirror_of(avatar).mirror_offset(offset.reshape(1, 3, h, w)).flatten(2)
    moved = (avatar.control.axes @ mirrored[0, :, avatar.control.cells].T[..., None])[..., 0]
    reflected = torch.stack([-points[:, 0] * points[:, 1], -points[:, 0] * 0.3, points[:, 0] * 0.2], -1)
    expected = reflected * FLIP
    near = torch.cdist(points * FLIP, points).amin(1) < 0.02
    assert near.float().mean() > 0.5
    assert (moved - expected)[near].norm(dim=1).max() < 0.03
    assert (moved - world)[near].norm(dim=1).mean() > 0.05


def test_only_the_rollouts_that_were_mirrored_are_turned_back():
    avatar = bare_avatar()
    h, w = avatar.control.size
    channels = avatar.model.appearance_channels
    output = NetworkOutput(torch.randn(2, 3, h, w), torch.randn(2, channels, h, w), ())
    turned = mirror_of(avatar).unmirror(output, torch.tensor([False, True]))
    assert torch.equal(turned.offset[0], output.offset[0])
    assert torch.equal(turned.appearance[0], output.appearance[0])
    expected = mirror_of(avatar).mirror_offset(output.offset)
    assert torch.equal(turned.offset[1], expected[1])
    assert not torch.equal(turned.offset[1], output.offset[1])
