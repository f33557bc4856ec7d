"""Numba kernels: Gaussians in the world to splats on the image, and the way back.

A splat's fall-off is kept as the Cholesky factor of its inverse covariance, in powers of two. With
d = mean - pixel:

    e1 = stretch dx - shear dy,  e2 = height dy,  log2 alpha = log2 opacity - e1² - e2².

Unlike the conic (a, b, c) this cannot turn negative by rounding, however thin the splat. A splat's record is
mean x, mean y, stretch, shear, height, log2 opacity, red, green, blue, z, limit, lift and, as integers, its
bounds: pixels first x, end x, first y, end y, all 0 if the Gaussian is not drawn; a cache line in all. Limit
is the largest dy on the splat's outline, lift the dy where dx is largest. Colour is left to kernels_shading.

Gaussians go through LANES at a time: their rows are first laid out as planes of a scratch array. Every kernel
takes `part` of `parts` and touches only those rows, so results do not depend on their number. The camera is
18 numbers: rotation (row-major 9), translation (3), fx, fy, cx, cy, the splats' dilation, and 1 if dilation
takes as much opacity as it adds area (Yu et al. 2024, Mip-Splatting), else 0.
"""

import math

import numpy as np

from dsar.raster.conventions import ALPHA_MIN, FRUSTUM_MARGIN, NEAR
from dsar.raster.jit import inlined, kernel
from dsar.raster.simd import (
    LANES,
    broadcast,
    floor,
    log2,
    maximum,
    minimum,
    plane,
    planes,
    select,
    sqrt,
    write_plane,
)
from dsar.raster.tiles import SUMS_SIZE

_NEAR = np.float32(NEAR)
_MARGIN = np.float32(0.5 * FRUSTUM_MARGIN)
_ALPHA_MIN = np.float32(ALPHA_MIN)
_LOG_ALPHA_MIN = np.float32(math.log2(ALPHA_MIN))
_LOG2_E, _LN_2 = np.float32(math.log2(math.e)), np.float32(math.log(2))
_FLOAT_MAX = np.finfo(np.float32).max
_ZERO, _HALF, _ONE, _TWO = (np.float32(value) for value in (0.0, 0.5, 1.0, 2.0))
# Scratch planes: what comes in (mean, rotation, scales, opacity, then the sums of the backward pass) ...
_MEAN, _ROTATION, _SCALES, _OPACITY, _SUMS = 0, 3, 7, 10, 11
# ... and, over it, what goes out: records and bounds, or gradients in the order of the inputs.
_BOUNDS, _PLANES = 12, 21


@inlined
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _sum(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def _row(matrix, start):
    """Return three consecutive values of a flat array."""
    return matrix[start], matrix[start + 1], matrix[start + 2]


@inlined
def _load_planes(scratch, start, end, means, rotations, scales, opacities):
    """Copy LANES rows into the scratch planes; the last row stands in for those beyond the end."""
    for lane in range(LANES):
        i = min(start + lane, end - 1)
        for k in range(3):
            scratch[(_MEAN + k) * LANES + lane] = means[i, k]
            scratch[(_SCALES + k) * LANES + lane] = scales[i, k]
        for k in range(4):
            scratch[(_ROTATION + k) * LANES + lane] = rotations[i, k]
        scratch[_OPACITY * LANES + lane] = opacities[i]


@inlined
def _unit_quaternion(scratch):
    """Return quaternions normalised, and the inverses of their norms (infinite for a zero quaternion)."""
    w, (x, y, z) = plane(scratch, _ROTATION), planes(scratch, _ROTATION + 1)
    inverse = _ONE / sqrt(w * w + x * x + y * y + z * z)
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
def _camera_point(mean, camera):
    """Return means in camera coordinates, metres."""
    return (
        _dot(_row(camera, 0), mean) + camera[9],
        _dot(_row(camera, 3), mean) + camera[10],
        _dot(_row(camera, 6), mean) + camera[11],
    )


@inlined
def _clamped_tangent(tangent, focal, center, size):
    """Return x/z limited to the widened image (beyond, linearising explodes), and where it was inside."""
    margin = _MARGIN * size / focal
    low, high = -center / focal - margin, (size - center) / focal + margin
    return minimum(maximum(tangent, broadcast(low)), broadcast(high)), (tangent >= low) & (tangent <= high)


@inlined
def _image_axes(point, camera, width, height):
    """Return d(pixel x)/d(world), d(pixel y)/d(world), and whether each was linearised at the mean itself."""
    inverse_z = _ONE / point[2]
    tx, unclamped_x = _clamped_tangent(point[0] * inverse_z, camera[12], camera[14], width)
    ty, unclamped_y = _clamped_tangent(point[1] * inverse_z, camera[13], camera[15], height)
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
    return u1, u2, unclamped_x, unclamped_y


@inlined
def _times_matrix(u, rows):
    """Return the row vector u times a matrix given by its rows."""
    return (
        u[0] * rows[0][0] + u[1] * rows[1][0] + u[2] * rows[2][0],
        u[0] * rows[0][1] + u[1] * rows[1][1] + u[2] * rows[2][1],
        u[0] * rows[0][2] + u[1] * rows[1][2] + u[2] * rows[2][2],
    )


@inlined
def _scaled(g, scales):
    return g[0] * scales[0], g[1] * scales[1], g[2] * scales[2]


@inlined
def _normal(g1, g2, scales):
    """Return the cross product of the covariance's factors, g1 scales and g2 scales, with all its digits."""
    w = _cross(g1, g2)
    return scales[1] * scales[2] * w[0], scales[2] * scales[0] * w[1], scales[0] * scales[1] * w[2]


@inlined
def _covariance(m1, m2, normal, dilation):
    """Return (A, B, C, A - B²/C) of the dilated image-plane covariance [[A, B], [B, C]], pixels².

    The determinant before dilation is normal²; unlike A C - B² it keeps its digits for thin splats.
    """
    a0, b, c0 = _dot(m1, m1), _dot(m1, m2), _dot(m2, m2)
    c = c0 + dilation
    determinant = _dot(normal, normal) + dilation * (a0 + c0) + dilation * dilation
    return a0 + dilation, b, c, determinant / c


@inlined
def _pixel_range(center, radius, size):
    """Return the first and end index of the pixels whose centres lie within a radius, inside the image."""
    first, end = -floor(radius + _HALF - center), floor(center + radius + _HALF)
    low, high = broadcast(_ZERO), broadcast(size)
    return minimum(maximum(first, low), high), minimum(maximum(end, low), high)


@inlined
def _project(scratch, camera, width, height):
    """Replace Gaussians in the scratch planes by their records and bounds."""
    mean, scales, opacity = planes(scratch, _MEAN), planes(scratch, _SCALES), plane(scratch, _OPACITY)
    point = _camera_point(mean, camera)
    w, x, y, z, inverse = _unit_quaternion(scratch)
    rows = _rotation_rows(w, x, y, z)
    u1, u2, _, _ = _image_axes(point, camera, width, height)
    g1, g2 = _times_matrix(u1, rows), _times_matrix(u2, rows)
    normal = _normal(g1, g2, scales)
    a, b, c, schur = _covariance(_scaled(g1, scales), _scaled(g2, scales), normal, camera[16])
    if camera[17] > _ZERO:
        opacity = opacity * sqrt(_dot(normal, normal) / (schur * c))
    mean_x = camera[12] * point[0] / point[2] + camera[14]
    mean_y = camera[13] * point[1] / point[2] + camera[15]
    log_opacity = log2(opacity)
    # Alpha is at least ALPHA_MIN within this many variances, squared, of the mean.
    reach = (_TWO * _LN_2) * (log_opacity - _LOG_ALPHA_MIN) + np.float32(1e-4)
    x0, x1 = _pixel_range(mean_x, sqrt(reach * a), width)
    y0, y1 = _pixel_range(mean_y, sqrt(reach * c), height)
    # Comparisons with NaN fail, and so does one with an infinite or NaN sum.
    finite = mean_x + mean_y + point[2] + a + c + schur + opacity
    sound = (finite <= _FLOAT_MAX) & (finite >= -_FLOAT_MAX)
    # A quaternion whose square overflows has no inverse norm.
    sound = sound & (inverse > _ZERO) & (minimum(minimum(scales[0], scales[1]), scales[2]) > _ZERO)
    drawn = sound & (point[2] > _NEAR) & (opacity >= _ALPHA_MIN) & (x0 < x1) & (y0 < y1)
    stretch = sqrt(_HALF * _LOG2_E / schur)
    write_plane(scratch, 0, mean_x)
    write_plane(scratch, 1, mean_y)
    write_plane(scratch, 2, stretch)
    write_plane(scratch, 3, stretch * b / c)
    write_plane(scratch, 4, sqrt(_HALF * _LOG2_E / c))
    write_plane(scratch, 5, log_opacity)
    write_plane(scratch, 9, point[2])
    write_plane(scratch, 10, sqrt(reach * c))
    write_plane(scratch, 11, b * sqrt(reach / a))
    nothing = broadcast(_ZERO)
    write_plane(scratch, _BOUNDS, select(drawn, x0, nothing))
    write_plane(scratch, _BOUNDS + 1, select(drawn, x1, nothing))
    write_plane(scratch, _BOUNDS + 2, select(drawn, y0, nothing))
    write_plane(scratch, _BOUNDS + 3, select(drawn, y1, nothing))


@kernel
def project_part(part, parts, means, rotations, scales, opacities, camera, width, height, records, bounds):
    """Write the records (all but colours) and bounds of one part of the Gaussians."""
    n = len(means)
    width, height = np.float32(width), np.float32(height)
    scratch = np.empty(_PLANES * LANES, np.float32)
    end = n * (part + 1) // parts
    for start in range(n * part // parts, end, LANES):
        _load_planes(scratch, start, end, means, rotations, scales, opacities)
        _project(scratch, camera, width, height)
        for lane in range(min(LANES, end - start)):
            for k in range(_BOUNDS):
                records[start + lane, k] = scratch[k * LANES + lane]
            for k in range(4):
                bounds[start + lane, k] = np.int32(scratch[(_BOUNDS + k) * LANES + lane])


@inlined
def _splat_gradient(scratch, a, b, c, schur):
    """Return dL/d(mean x, mean y, A, B, C) from a splat's sums over its pixels (see kernels_compositing)."""
    stretch, height, ratio = sqrt(_HALF * _LOG2_E / schur), sqrt(_HALF * _LOG2_E / c), b / c
    # The sums are of powers of e, the factors in powers of two.
    v_e1, v_e2 = (_TWO * _LN_2) * plane(scratch, _SUMS + 1), (_TWO * _LN_2) * plane(scratch, _SUMS + 2)
    v_e11, v_e12, v_e22 = planes(scratch, _SUMS + 3)
    v_x = stretch * v_e1
    v_y = height * v_e2 - ratio * stretch * v_e1
    v_schur = -(_LN_2 * v_e11 / schur)
    v_ratio = -((_TWO * _LN_2) * stretch / height * v_e12)
    v_b = v_ratio / c - _TWO * v_schur * ratio
    v_c = v_schur * ratio * ratio - (v_ratio * ratio + _LN_2 * v_e22) / c
    return v_x, v_y, v_schur, v_b, v_c


@inlined
def _write_rotation_gradient(scratch, u1, u2, v_g1, v_g2, quaternion):
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
    twice = _TWO * inverse
    write_plane(scratch, _ROTATION, twice * (v_w - w * radial))
    write_plane(scratch, _ROTATION + 1, twice * (v_x - x * radial))
    write_plane(scratch, _ROTATION + 2, twice * (v_y - y * radial))
    write_plane(scratch, _ROTATION + 3, twice * (v_z - z * radial))


@inlined
def _write_mean_gradient(scratch, point, camera, u1, u2, unclamped_x, unclamped_y, v_u1, v_u2, v_x, v_y):
    """Chain dL/d(image axes, mean on the image, depth) to the mean in the world."""
    inverse_z = _ONE / point[2]
    fx, fy, forward = camera[12] * inverse_z, camera[13] * inverse_z, _row(camera, 6)
    # A clamped tangent is a constant of the linearisation.
    v_tx = select(unclamped_x, -(fx * _dot(v_u1, forward)), broadcast(_ZERO))
    v_ty = select(unclamped_y, -(fy * _dot(v_u2, forward)), broadcast(_ZERO))
    v_right = (camera[12] * v_x + v_tx) * inverse_z
    v_down = (camera[13] * v_y + v_ty) * inverse_z
    # u1 and u2 are proportional to 1/z, and so are the tangents.
    v_log_z = _dot(v_u1, u1) + _dot(v_u2, u2) + v_right * point[0] + v_down * point[1]
    v_forward = plane(scratch, _SUMS + 9) - v_log_z * inverse_z
    right, down = _row(camera, 0), _row(camera, 3)
    for axis in range(3):
        v_mean = right[axis] * v_right + down[axis] * v_down + forward[axis] * v_forward
        write_plane(scratch, _MEAN + axis, v_mean)


@inlined
def _normal_gradient(v_log, normal, g1, g2, scales):
    """Return the gradients of v_log * log |normal| by scales, g1 and g2."""
    x, y, z = normal[0] * normal[0], normal[1] * normal[1], normal[2] * normal[2]
    share = v_log / (x + y + z)
    v_scales = share * (y + z) / scales[0], share * (z + x) / scales[1], share * (x + y) / scales[2]
    v_w = (
        share * normal[0] * scales[1] * scales[2],
        share * normal[1] * scales[2] * scales[0],
        share * normal[2] * scales[0] * scales[1],
    )
    return v_scales, _cross(g2, v_w), _cross(v_w, g1)


@inlined
def _project_backward(scratch, camera, width, height):
    """Replace Gaussians in the scratch planes by their gradients."""
    mean, scales, opacity = planes(scratch, _MEAN), planes(scratch, _SCALES), plane(scratch, _OPACITY)
    point = _camera_point(mean, camera)
    quaternion = _unit_quaternion(scratch)
    rows = _rotation_rows(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
    u1, u2, unclamped_x, unclamped_y = _image_axes(point, camera, width, height)
    g1, g2 = _times_matrix(u1, rows), _times_matrix(u2, rows)
    m1, m2 = _scaled(g1, scales), _scaled(g2, scales)
    normal = _normal(g1, g2, scales)
    a, b, c, schur = _covariance(m1, m2, normal, camera[16])
    v_x, v_y, v_a, v_b, v_c = _splat_gradient(scratch, a, b, c, schur)
    # Antialiased, opacity is proportional to |normal| / sqrt(schur c).
    v_log = -plane(scratch, _SUMS) if camera[17] > _ZERO else broadcast(_ZERO)
    v_a += -(_HALF * v_log / schur)
    v_b += v_log * b / (schur * c)
    v_c += -(_HALF * v_log * a / (schur * c))
    twice_a, twice_c = _TWO * v_a, _TWO * v_c
    v_m1 = (
        twice_a * m1[0] + v_b * m2[0],
        twice_a * m1[1] + v_b * m2[1],
        twice_a * m1[2] + v_b * m2[2],
    )
    v_m2 = (
        twice_c * m2[0] + v_b * m1[0],
        twice_c * m2[1] + v_b * m1[1],
        twice_c * m2[2] + v_b * m1[2],
    )
    v_scales = (
        v_m1[0] * g1[0] + v_m2[0] * g2[0],
        v_m1[1] * g1[1] + v_m2[1] * g2[1],
        v_m1[2] * g1[2] + v_m2[2] * g2[2],
    )
    v_g1, v_g2 = _scaled(v_m1, scales), _scaled(v_m2, scales)
    if camera[17] > _ZERO:
        extra, extra1, extra2 = _normal_gradient(v_log, normal, g1, g2, scales)
        v_scales, v_g1, v_g2 = _sum(v_scales, extra), _sum(v_g1, extra1), _sum(v_g2, extra2)
    write_plane(scratch, _SCALES, v_scales[0])
    write_plane(scratch, _SCALES + 1, v_scales[1])
    write_plane(scratch, _SCALES + 2, v_scales[2])
    _write_rotation_gradient(scratch, u1, u2, v_g1, v_g2, quaternion)
    v_u1 = (_dot(rows[0], v_g1), _dot(rows[1], v_g1), _dot(rows[2], v_g1))
    v_u2 = (_dot(rows[0], v_g2), _dot(rows[1], v_g2), _dot(rows[2], v_g2))
    _write_mean_gradient(scratch, point, camera, u1, u2, unclamped_x, unclamped_y, v_u1, v_u2, v_x, v_y)
    write_plane(scratch, _OPACITY, -(plane(scratch, _SUMS) / opacity))


@kernel
def project_backward_part(
    part, parts, means, rotations, scales, opacities, camera, width, height, bounds, sums,
    v_means, v_rotations, v_scales, v_opacities,
):  # fmt: skip
    """Write the gradients of one part of the Gaussians; those that were not drawn keep what is there."""
    n = len(means)
    width, height = np.float32(width), np.float32(height)
    scratch = np.empty(_PLANES * LANES, np.float32)
    end = n * (part + 1) // parts
    for start in range(n * part // parts, end, LANES):
        _load_planes(scratch, start, end, means, rotations, scales, opacities)
        for lane in range(LANES):
            for k in range(SUMS_SIZE):
                scratch[(_SUMS + k) * LANES + lane] = sums[min(start + lane, end - 1), k]
        _project_backward(scratch, camera, width, height)
        for lane in range(min(LANES, end - start)):
            i = start + lane
            if bounds[i, 1] == 0:
                continue
            for k in range(3):
                v_means[i, k] = scratch[(_MEAN + k) * LANES + lane]
                v_scales[i, k] = scratch[(_SCALES + k) * LANES + lane]
            for k in range(4):
                v_rotations[i, k] = scratch[(_ROTATION + k) * LANES + lane]
            v_opacities[i] = scratch[_OPACITY * LANES + lane]
