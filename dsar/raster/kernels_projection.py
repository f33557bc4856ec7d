"""Numba kernels: Gaussians in the world to splats on the image, and the way back.

A splat's fall-off is kept as the Cholesky factor of its inverse covariance. With d = mean - pixel:

    e1 = stretch dx - shear dy,  e2 = height dy,  alpha = opacity exp(-(e1² + e2²)).

Unlike the conic (a, b, c) this cannot turn negative by rounding, however thin the splat. A splat's record is
mean x, mean y, stretch, shear, height, opacity, red, green, blue, z, first row, end row; the colour is left
to kernels_shading. Bounds are the pixels first x, end x, first y, end y; all 0 if a Gaussian is not drawn.

Every kernel takes `part` of `parts` and touches only those rows, so results do not depend on their number.
The camera is 17 numbers: rotation (row-major 9), translation (3), fx, fy, cx, cy, and the splats' dilation.
"""

import math

import numpy as np

from dsar.raster.conventions import ALPHA_MIN, FRUSTUM_MARGIN, NEAR
from dsar.raster.jit import inlined, kernel

RECORD_SIZE = 12
_NEAR = np.float32(NEAR)
_MARGIN = np.float32(0.5 * FRUSTUM_MARGIN)
_ALPHA_MIN = np.float32(ALPHA_MIN)
_LARGEST = np.finfo(np.float32).max
_ZERO, _HALF, _ONE, _TWO = (np.float32(value) for value in (0.0, 0.5, 1.0, 2.0))


@inlined
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _row(matrix, start):
    """Return three consecutive values of a flat array."""
    return matrix[start], matrix[start + 1], matrix[start + 2]


@inlined
def _unit_quaternion(rotations, i):
    """Return one quaternion normalised, and the inverse of its norm (infinite for a zero quaternion)."""
    w, x, y, z = rotations[i, 0], rotations[i, 1], rotations[i, 2], rotations[i, 3]
    squared = w * w + x * x + y * y + z * z
    inverse = _ONE / math.sqrt(squared) if squared > _ZERO else np.float32(np.inf)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@inlined
def _rotation_rows(w, x, y, z):
    """Return the rows of the rotation matrix of a unit quaternion."""
    return (
        (_ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y)),
        (_TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x)),
        (_TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y)),
    )


@inlined
def _camera_point(means, camera, i):
    """Return one mean in camera coordinates, metres."""
    mean = (means[i, 0], means[i, 1], means[i, 2])
    return (
        _dot(_row(camera, 0), mean) + camera[9],
        _dot(_row(camera, 3), mean) + camera[10],
        _dot(_row(camera, 6), mean) + camera[11],
    )


@inlined
def _clamped_tangent(tangent, focal, center, size):
    """Return x/z limited to the widened image: beyond it the linearised projection explodes."""
    margin = _MARGIN * size / focal
    return min(max(tangent, -center / focal - margin), (size - center) / focal + margin)


@inlined
def _image_axes(point, camera, width, height):
    """Return d(pixel x)/d(world), d(pixel y)/d(world), and whether each was linearised at the mean itself."""
    inverse_z = _ONE / point[2]
    tan_x, tan_y = point[0] * inverse_z, point[1] * inverse_z
    tx = _clamped_tangent(tan_x, camera[12], camera[14], width)
    ty = _clamped_tangent(tan_y, camera[13], camera[15], height)
    fx, fy = camera[12] * inverse_z, camera[13] * inverse_z
    right, down, forward = _row(camera, 0), _row(camera, 3), _row(camera, 6)
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
    return u1, u2, tx == tan_x, ty == tan_y


@inlined
def _times_matrix(u, rows):
    """Return the row vector u times a matrix given by its rows."""
    return (
        u[0] * rows[0][0] + u[1] * rows[1][0] + u[2] * rows[2][0],
        u[0] * rows[0][1] + u[1] * rows[1][1] + u[2] * rows[2][1],
        u[0] * rows[0][2] + u[1] * rows[1][2] + u[2] * rows[2][2],
    )


@inlined
def _scaled(g, scales, i):
    return g[0] * scales[i, 0], g[1] * scales[i, 1], g[2] * scales[i, 2]


@inlined
def _covariance(m1, m2, dilation):
    """Return (A, B, C, A - B²/C) of the image-plane covariance [[A, B], [B, C]], pixels².

    The determinant comes from the cross product, which keeps its digits for thin splats.
    """
    a0, b, c0 = _dot(m1, m1), _dot(m1, m2), _dot(m2, m2)
    nx = m1[1] * m2[2] - m1[2] * m2[1]
    ny = m1[2] * m2[0] - m1[0] * m2[2]
    nz = m1[0] * m2[1] - m1[1] * m2[0]
    c = c0 + dilation
    determinant = nx * nx + ny * ny + nz * nz + dilation * (a0 + c0) + dilation * dilation
    return a0 + dilation, b, c, determinant / c


@inlined
def _pixel_range(center, radius, size):
    """Return the first and end index of the pixels whose centres lie within a radius, inside the image."""
    first = min(max(math.ceil(center - radius - _HALF), _ZERO), size)
    end = min(max(math.floor(center + radius + _HALF), _ZERO), size)
    return np.int32(first), np.int32(end)


@kernel
def project_part(part, parts, means, rotations, scales, opacities, camera, width, height, records, bounds):
    """Write the records (all but colours) and bounds of one part of the Gaussians."""
    n = len(means)
    width, height = np.float32(width), np.float32(height)
    for i in range(n * part // parts, n * (part + 1) // parts):
        bounds[i, 0] = bounds[i, 1] = bounds[i, 2] = bounds[i, 3] = 0
        opacity = opacities[i]
        point = _camera_point(means, camera, i)
        smallest = min(scales[i, 0], scales[i, 1], scales[i, 2])
        if not (point[2] > _NEAR and opacity >= _ALPHA_MIN and smallest > _ZERO):
            continue
        w, x, y, z, _ = _unit_quaternion(rotations, i)
        rows = _rotation_rows(w, x, y, z)
        u1, u2, _, _ = _image_axes(point, camera, width, height)
        m1, m2 = _scaled(_times_matrix(u1, rows), scales, i), _scaled(_times_matrix(u2, rows), scales, i)
        a, b, c, slim = _covariance(m1, m2, camera[16])
        mean_x = camera[12] * point[0] / point[2] + camera[14]
        mean_y = camera[13] * point[1] / point[2] + camera[15]
        # Not math.isfinite: it subtracts the value from itself, which the compiler may fold to zero.
        if not abs(mean_x + mean_y + a + c + slim + opacity) <= _LARGEST:
            continue
        # The splat's alpha is at least ALPHA_MIN exactly where e1² + e2² <= log(opacity / ALPHA_MIN).
        reach = _TWO * math.log(opacity / _ALPHA_MIN) + np.float32(1e-4)
        x0, x1 = _pixel_range(mean_x, math.sqrt(reach * a), width)
        y0, y1 = _pixel_range(mean_y, math.sqrt(reach * c), height)
        if x0 >= x1 or y0 >= y1:
            continue
        bounds[i, 0], bounds[i, 1], bounds[i, 2], bounds[i, 3] = x0, x1, y0, y1
        stretch = _ONE / math.sqrt(_TWO * slim)
        records[i, 0], records[i, 1] = mean_x, mean_y
        records[i, 2], records[i, 3] = stretch, stretch * b / c
        records[i, 4], records[i, 5] = _ONE / math.sqrt(_TWO * c), opacity
        records[i, 9], records[i, 10], records[i, 11] = point[2], np.float32(y0), np.float32(y1)


@inlined
def _splat_gradient(sums, i, a, b, c, slim):
    """Return dL/d(mean x, mean y, A, B, C) from a splat's sums over its pixels (see kernels_compositing)."""
    stretch, height, ratio = _ONE / math.sqrt(_TWO * slim), _ONE / math.sqrt(_TWO * c), b / c
    v_x = _TWO * stretch * sums[i, 1]
    v_y = _TWO * (height * sums[i, 2] - ratio * stretch * sums[i, 1])
    v_slim = -sums[i, 3] / slim
    v_ratio = -_TWO * stretch / height * sums[i, 4]
    v_b = v_ratio / c - _TWO * v_slim * ratio
    v_c = v_slim * ratio * ratio - (v_ratio * ratio + sums[i, 5]) / c
    return v_x, v_y, v_slim, v_b, v_c


@inlined
def _write_rotation_gradient(u1, u2, v_g1, v_g2, quaternion, v_rotations, i):
    """Chain dL/dR = u1ᵀ v_g1 + u2ᵀ v_g2 through the quaternion and its normalisation."""
    w, x, y, z, inverse = quaternion
    v00, v11, v22 = (
        u1[0] * v_g1[0] + u2[0] * v_g2[0],
        u1[1] * v_g1[1] + u2[1] * v_g2[1],
        u1[2] * v_g1[2] + u2[2] * v_g2[2],
    )
    v01, v10 = u1[0] * v_g1[1] + u2[0] * v_g2[1], u1[1] * v_g1[0] + u2[1] * v_g2[0]
    v02, v20 = u1[0] * v_g1[2] + u2[0] * v_g2[2], u1[2] * v_g1[0] + u2[2] * v_g2[0]
    v12, v21 = u1[1] * v_g1[2] + u2[1] * v_g2[2], u1[2] * v_g1[1] + u2[2] * v_g2[1]
    v_w = x * (v21 - v12) + y * (v02 - v20) + z * (v10 - v01)
    v_x = y * (v01 + v10) + z * (v02 + v20) - _TWO * x * (v11 + v22) + w * (v21 - v12)
    v_y = x * (v01 + v10) + z * (v12 + v21) - _TWO * y * (v00 + v22) + w * (v02 - v20)
    v_z = x * (v02 + v20) + y * (v12 + v21) - _TWO * z * (v00 + v11) + w * (v10 - v01)
    radial = w * v_w + x * v_x + y * v_y + z * v_z
    v_rotations[i, 0] = _TWO * inverse * (v_w - w * radial)
    v_rotations[i, 1] = _TWO * inverse * (v_x - x * radial)
    v_rotations[i, 2] = _TWO * inverse * (v_y - y * radial)
    v_rotations[i, 3] = _TWO * inverse * (v_z - z * radial)


@inlined
def _write_mean_gradient(point, camera, u1, u2, free_x, free_y, v_u1, v_u2, v_x, v_y, v_depth, v_means, i):
    """Chain dL/d(image axes, mean on the image, depth) to the mean in the world."""
    inverse_z = _ONE / point[2]
    fx, fy, forward = camera[12] * inverse_z, camera[13] * inverse_z, _row(camera, 6)
    v_tx, v_ty = -fx * _dot(v_u1, forward), -fy * _dot(v_u2, forward)
    # A clamped tangent is a constant of the linearisation.
    v_tx = v_tx if free_x else _ZERO
    v_ty = v_ty if free_y else _ZERO
    v_right = (camera[12] * v_x + v_tx) * inverse_z
    v_down = (camera[13] * v_y + v_ty) * inverse_z
    # u1 and u2 are proportional to 1/z, and so are the tangents.
    v_log_z = _dot(v_u1, u1) + _dot(v_u2, u2) + v_right * point[0] + v_down * point[1]
    v_forward = v_depth - v_log_z * inverse_z
    right, down = _row(camera, 0), _row(camera, 3)
    for axis in range(3):
        v_means[i, axis] = right[axis] * v_right + down[axis] * v_down + forward[axis] * v_forward


@kernel
def project_backward_part(
    part, parts, means, rotations, scales, opacities, camera, width, height, bounds, sums,
    v_means, v_rotations, v_scales, v_opacities,
):  # fmt: skip
    """Write the gradients of one part of the Gaussians; those that were not drawn keep what is there."""
    n = len(means)
    width, height = np.float32(width), np.float32(height)
    for i in range(n * part // parts, n * (part + 1) // parts):
        if bounds[i, 1] == 0:
            continue
        point = _camera_point(means, camera, i)
        quaternion = _unit_quaternion(rotations, i)
        rows = _rotation_rows(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
        u1, u2, free_x, free_y = _image_axes(point, camera, width, height)
        g1, g2 = _times_matrix(u1, rows), _times_matrix(u2, rows)
        m1, m2 = _scaled(g1, scales, i), _scaled(g2, scales, i)
        a, b, c, slim = _covariance(m1, m2, camera[16])
        v_x, v_y, v_a, v_b, v_c = _splat_gradient(sums, i, a, b, c, slim)
        v_m1 = (
            _TWO * v_a * m1[0] + v_b * m2[0],
            _TWO * v_a * m1[1] + v_b * m2[1],
            _TWO * v_a * m1[2] + v_b * m2[2],
        )
        v_m2 = (
            _TWO * v_c * m2[0] + v_b * m1[0],
            _TWO * v_c * m2[1] + v_b * m1[1],
            _TWO * v_c * m2[2] + v_b * m1[2],
        )
        for axis in range(3):
            v_scales[i, axis] = v_m1[axis] * g1[axis] + v_m2[axis] * g2[axis]
        v_g1, v_g2 = _scaled(v_m1, scales, i), _scaled(v_m2, scales, i)
        _write_rotation_gradient(u1, u2, v_g1, v_g2, quaternion, v_rotations, i)
        v_u1 = (_dot(rows[0], v_g1), _dot(rows[1], v_g1), _dot(rows[2], v_g1))
        v_u2 = (_dot(rows[0], v_g2), _dot(rows[1], v_g2), _dot(rows[2], v_g2))
        _write_mean_gradient(
            point, camera, u1, u2, free_x, free_y, v_u1, v_u2, v_x, v_y, sums[i, 9], v_means, i
        )
        v_opacities[i] = -sums[i, 0] / opacities[i]
