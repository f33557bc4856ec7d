"""From a Gaussian in the world to its ellipse on the image, LANES at a time: what both ways share.

The covariance on the image is the product of two factors, d(pixel)/d(world) R S and its transpose; see
kernels_projection for the camera's 18 numbers.
"""

import numpy as np

from dsar.raster.conventions import FRUSTUM_MARGIN
from dsar.raster.jit import inlined
from dsar.raster.simd import LANES, broadcast, maximum, minimum, plane, planes, sqrt

# Scratch planes: what comes in (mean, rotation, scales, opacity, then the sums of the backward pass) ...
MEAN, ROTATION, SCALES, OPACITY, SUMS = 0, 3, 7, 10, 11
# ... and, over it, what goes out: records and bounds, or gradients in the order of the inputs.
BOUNDS, PLANES = 12, 21

_MARGIN = np.float32(0.5 * FRUSTUM_MARGIN)
_ONE, _TWO = np.float32(1.0), np.float32(2.0)


@inlined
def dot(a, b):
    """Return the dot product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def add(a, b):
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined
def cross(a, b):
    """Return the cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def row(matrix, start):
    """Return three consecutive values of a flat array."""
    return matrix[start], matrix[start + 1], matrix[start + 2]


@inlined
def load_planes(scratch, start, end, means, rotations, scales, opacities):
    """Copy LANES rows into the scratch planes; the last row stands in for those beyond the end."""
    for lane in range(LANES):
        i = min(start + lane, end - 1)
        for k in range(3):
            scratch[(MEAN + k) * LANES + lane] = means[i, k]
            scratch[(SCALES + k) * LANES + lane] = scales[i, k]
        for k in range(4):
            scratch[(ROTATION + k) * LANES + lane] = rotations[i, k]
        scratch[OPACITY * LANES + lane] = opacities[i]


@inlined
def unit_quaternion(scratch):
    """Return quaternions normalised, and the inverses of their norms (infinite for a zero quaternion)."""
    w, (x, y, z) = plane(scratch, ROTATION), planes(scratch, ROTATION + 1)
    inverse = _ONE / sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@inlined
def rotation_rows(w, x, y, z):
    """Return the rows of the rotation matrix of a unit quaternion."""
    return (
        (_ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y)),
        (_TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x)),
        (_TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y)),
    )


@inlined
def camera_point(mean, camera):
    """Return means in camera coordinates, metres."""
    return (
        dot(row(camera, 0), mean) + camera[9],
        dot(row(camera, 3), mean) + camera[10],
        dot(row(camera, 6), mean) + camera[11],
    )


@inlined
def clamped_tangent(tangent, focal, center, size):
    """Return x/z limited to the widened image (beyond, linearising explodes), and where it was inside."""
    margin = _MARGIN * size / focal
    low, high = -center / focal - margin, (size - center) / focal + margin
    return minimum(maximum(tangent, broadcast(low)), broadcast(high)), (tangent >= low) & (tangent <= high)


@inlined
def image_axes(point, camera, width, height):
    """Return d(pixel x)/d(world), d(pixel y)/d(world), and whether each was linearised at the mean itself."""
    inverse_z = _ONE / point[2]
    tx, unclamped_x = clamped_tangent(point[0] * inverse_z, camera[12], camera[14], width)
    ty, unclamped_y = clamped_tangent(point[1] * inverse_z, camera[13], camera[15], height)
    fx, fy = camera[12] * inverse_z, camera[13] * inverse_z
    right, down, forward = row(camera, 0), row(camera, 3), row(camera, 6)
    u1 = (
        fx * (right[0] - tx * forward[0]),
        fx * (right[1] - tx * forward[1]),
        fx * (right[2] - tx * forward[2]),
    )
    u2 = (
        fy * (down[0] - ty * forward[0]),
        fy * (down[1] - ty * forward[1]),
        fy * (down[2] - ty * forward[2]),
    )
    return u1, u2, unclamped_x, unclamped_y


@inlined
def times_matrix(u, rows):
    """Return the row vector u times a matrix given by its rows."""
    return (
        u[0] * rows[0][0] + u[1] * rows[1][0] + u[2] * rows[2][0],
        u[0] * rows[0][1] + u[1] * rows[1][1] + u[2] * rows[2][1],
        u[0] * rows[0][2] + u[1] * rows[1][2] + u[2] * rows[2][2],
    )


@inlined
def scaled(g, scales):
    """Return a factor of the covariance: axes times standard deviations."""
    return g[0] * scales[0], g[1] * scales[1], g[2] * scales[2]


@inlined
def factor_normal(g1, g2, scales):
    """Return the cross product of the covariance's factors, g1 scales and g2 scales, with all its digits."""
    w = cross(g1, g2)
    return scales[1] * scales[2] * w[0], scales[2] * scales[0] * w[1], scales[0] * scales[1] * w[2]


@inlined
def covariance(m1, m2, normal, dilation):
    """Return (A, B, C, A - B²/C) of the dilated image-plane covariance [[A, B], [B, C]], pixels².

    The determinant before dilation is normal²; unlike A C - B² it keeps its digits for thin splats.
    """
    a0, b, c0 = dot(m1, m1), dot(m1, m2), dot(m2, m2)
    c = c0 + dilation
    determinant = dot(normal, normal) + dilation * (a0 + c0) + dilation * dilation
    return a0 + dilation, b, c, determinant / c
