"""Rotations as unit quaternions (wxyz), matrices and axis-angles; all functions broadcast over batch axes."""

import torch
from jaxtyping import Float
from torch import Tensor


def matrix_from_quaternion(quaternion: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Return the rotation matrix of a quaternion wxyz, which need not be normalised but must not be zero."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def quaternion_from_matrix(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Return the unit quaternion wxyz, w >= 0, of a rotation matrix.

    Of the four algebraically equal forms the best conditioned is chosen per element (Shepperd 1978).
    """
    m = matrix
    trace = m.diagonal(dim1=-2, dim2=-1)
    x, y, z = trace.unbind(-1)
    squares = torch.stack([1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], -1)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    candidates = torch.stack(
        [
            torch.stack([squares[..., 0], a, b, c], -1),
            torch.stack([a, squares[..., 1], d, e], -1),
            torch.stack([b, d, squares[..., 2], f], -1),
            torch.stack([c, e, f, squares[..., 3]], -1),
        ],
        -2,
    )
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quaternion = torch.nn.functional.normalize(candidates.gather(-2, best).squeeze(-2), dim=-1)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def matrix_from_axis_angle(axis_angle: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return the rotation matrix of an axis times an angle in radians; smooth at zero."""
    return matrix_from_quaternion(quaternion_from_axis_angle(axis_angle))


def quaternion_from_axis_angle(axis_angle: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4"]:
    """Return the unit quaternion wxyz of an axis times an angle in radians; smooth at zero."""
    half = 0.5 * axis_angle
    squared = half.square().sum(-1, keepdim=True)
    angle = squared.clamp_min(1e-12).sqrt()
    # sin(a)/a and cos(a) by their series where the quotient loses its digits.
    small = squared < 1e-6
    sinc = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    cosine = torch.where(small, 1 - squared / 2, angle.cos())
    return torch.cat([cosine, half * sinc], -1)


def axis_angle_from_matrix(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Return axis times angle in radians, angle in [0, pi]."""
    quaternion = quaternion_from_matrix(matrix)
    w, vector = quaternion[..., :1], quaternion[..., 1:]
    sine = vector.norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, w)
    return vector * torch.where(sine > 1e-7, angle / sine.clamp_min(1e-7), 2.0)


def quaternion_multiply(left: Float[Tensor, "*b 4"], right: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """Return the Hamilton product: the rotation `right` followed by `left`."""
    aw, ax, ay, az = left.unbind(-1)
    bw, bx, by, bz = right.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def nearest_rotation(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return the rotation closest to a matrix in the Frobenius norm (its polar factor, det = +1)."""
    u, _, vh = torch.linalg.svd(matrix)
    sign = torch.linalg.det(u @ vh)
    u = torch.cat([u[..., :2], u[..., 2:] * sign[..., None, None]], -1)
    return u @ vh


def heading_matrix(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return the yaw about the world's Y axis that carries +Z to the rotation's heading.

    The heading is the direction of the rotated +Z axis (a body's front) in the ground plane; where
    that is vertical (a body lying down) the rotated +Y axis decides.
    """
    forward, up = matrix[..., :, 2], matrix[..., :, 1]
    vertical = (forward[..., 1].abs() > 0.99)[..., None]
    # Bent forward until the front looks down, the head points where the front did; bent back, opposite.
    direction = torch.where(vertical, -up * forward[..., 1:2].sign(), forward)
    x, z = direction[..., 0], direction[..., 2]
    norm = (x * x + z * z).sqrt().clamp_min(1e-9)
    s, c, zero, one = x / norm, z / norm, torch.zeros_like(x), torch.ones_like(x)
    rows = ((c, zero, s), (zero, one, zero), (-s, zero, c))
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
