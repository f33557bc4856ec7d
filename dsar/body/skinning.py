"""Forward kinematics and linear blend skinning with SMPL-X semantics, differentiable in every input.

vertex = sum_k w_k T_k v_rest, where T_k rotates joint k, and all that hangs on it, about the joint's
rest position, and `translation` is added last (Loper et al. 2015, without pose blend shapes: what a
pose does beyond skinning is learned).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.geometry.rotations import matrix_from_axis_angle
from dsar.types import Body, Pose


def forward_kinematics(
    body: Body, rotations: Float[Tensor, "*b j 3"], translations: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b j 4 4"]:
    """Return T_world_rest of every joint: where the joint carries points of the rest pose.

    Args:
        body: the skeleton, in the precision and on the device of the other two.
        rotations: axis-angle relative to the parent, radians; joint 0 relative to the world.
        translations: SMPL-X `transl`, world metres. The pelvis turns about its own rest position, so
            a zero translation leaves it there.
    """
    offsets = body.joints - body.joints[[max(parent, 0) for parent in body.parents]]
    offsets = torch.cat([body.joints[:1], offsets[1:]]).expand(rotations.shape)
    local = _rigid(matrix_from_axis_angle(rotations), offsets).unbind(-3)
    world = [local[0]]
    for joint in range(1, len(local)):
        world.append(world[body.parents[joint]] @ local[joint])
    posed = torch.stack(world, -3)
    world_rotations, joint_positions = posed[..., :3, :3], posed[..., :3, 3]
    shifts = (
        joint_positions - (world_rotations @ body.joints[:, :, None]).squeeze(-1) + translations[..., None, :]
    )
    return _rigid(world_rotations, shifts)


def blend_transforms(
    weights: Float[Tensor, "n j"], transforms: Float[Tensor, "*b j 4 4"]
) -> Float[Tensor, "*b n 3 4"]:
    """Return the weighted mean of joint transforms per point (rows of `weights` sum to 1).

    The left 3x3 block is not a rotation where joints disagree; `nearest_rotation` makes it one.
    """
    return (weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))


def skin_points(
    points: Float[Tensor, "n 3"], weights: Float[Tensor, "n j"], transforms: Float[Tensor, "j 4 4"]
) -> Float[Tensor, "n 3"]:
    """Return rest points, metres, carried by T_world_rest of the joints, blended (paper equation 1)."""
    blended = blend_transforms(weights, transforms)
    return (blended[:, :, :3] @ points[:, :, None]).squeeze(-1) + blended[:, :, 3]


def pose_vertices(body: Body, pose: Pose) -> Float[Tensor, "v 3"]:
    """Return the body's vertices in a pose, world metres."""
    transforms = forward_kinematics(body, pose.rotations, pose.translation)
    return skin_points(body.vertices, body.weights, transforms)


def _rigid(rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """Return 4x4 matrices of a rotation followed by a translation."""
    top = torch.cat([rotation, translation[..., None]], -1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], -2)
