"""Numba kernels: from the gradients of splats on the image back to Gaussians in the world."""

import math

import numpy as np

from dsar.raster.jit import inlined, kernel
from dsar.raster.projection_geometry import (
    MEAN,
    OPACITY,
    PLANES,
    ROTATION,
    SCALES,
    SUMS,
    add,
    camera_point,
    covariance,
    cross,
    dot,
    factor_normal,
    image_axes,
    load_planes,
    rotation_rows,
    row,
    scaled,
    times_matrix,
    unit_quaternion,
)
from dsar.raster.simd import LANES, broadcast, plane, planes, select, sqrt, write_plane
from dsar.raster.tiles import SUMS_SIZE

_LOG2_E, _LN2 = np.float32(math.log2(math.e)), np.float32(math.log(2))
_ZERO, _HALF, _ONE, _TWO = (np.float32(value) for value in (0.0, 0.5, 1.0, 2.0))


@inlined
def _splat_gradient(scratch, a, b, c, schur):
    """Return dL/d(mean x, mean y, A, B, C) from a splat's sums over its pixels (see kernels_compositing)."""
    stretch, height, ratio = sqrt(_HALF * _LOG2_E / schur), sqrt(_HALF * _LOG2_E / c), b / c
    # The sums are of powers of e, the factors in powers of two.
    v_e1, v_e2 = (_TWO * _LN2) * plane(scratch, SUMS + 1), (_TWO * _LN2) * plane(scratch, SUMS + 2)
    v_e11, v_e12, v_e22 = planes(scratch, SUMS + 3)
    v_x = stretch * v_e1
    v_y = height * v_e2 - ratio * stretch * v_e1
    v_schur = -(_LN2 * v_e11 / schur)
    v_ratio = -((_TWO * _LN2) * stretch / height * v_e12)
    v_b = v_ratio / c - _TWO * v_schur * ratio
    v_c = v_schur * ratio * ratio - (v_ratio * ratio + _LN2 * v_e22) / c
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
    write_plane(scratch, ROTATION, twice * (v_w - w * radial))
    write_plane(scratch, ROTATION + 1, twice * (v_x - x * radial))
    write_plane(scratch, ROTATION + 2, twice * (v_y - y * radial))
    write_plane(scratch, ROTATION + 3, twice * (v_z - z * radial))


@inlined
def _write_mean_gradient(scratch, point, camera, u1, u2, unclamped_x, unclamped_y, v_u1, v_u2, v_x, v_y):
    """Chain dL/d(image axes, mean on the image, depth) to the mean in the world."""
    inverse_z = _ONE / point[2]
    fx, fy, forward = camera[12] * inverse_z, camera[13] * inverse_z, row(camera, 6)
    # A clamped tangent is a constant of the linearisation.
    v_tx = select(unclamped_x, -(fx * dot(v_u1, forward)), broadcast(_ZERO))
    v_ty = select(unclamped_y, -(fy * dot(v_u2, forward)), broadcast(_ZERO))
    v_right = (camera[12] * v_x + v_tx) * inverse_z
    v_down = (camera[13] * v_y + v_ty) * inverse_z
    # u1 and u2 are proportional to 1/z, and so are the tangents.
    v_log_z = dot(v_u1, u1) + dot(v_u2, u2) + v_right * point[0] + v_down * point[1]
    v_forward = plane(scratch, SUMS + 9) - v_log_z * inverse_z
    right, down = row(camera, 0), row(camera, 3)
    for axis in range(3):
        v_mean = right[axis] * v_right + down[axis] * v_down + forward[axis] * v_forward
        write_plane(scratch, MEAN + axis, v_mean)


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
    return v_scales, cross(g2, v_w), cross(v_w, g1)


@inlined
def _project_backward(scratch, camera, width, height):
    """Replace Gaussians in the scratch planes by their gradients."""
    mean, scales, opacity = planes(scratch, MEAN), planes(scratch, SCALES), plane(scratch, OPACITY)
    point = camera_point(mean, camera)
    quaternion = unit_quaternion(scratch)
    rows = rotation_rows(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
    u1, u2, unclamped_x, unclamped_y = image_axes(point, camera, width, height)
    g1, g2 = times_matrix(u1, rows), times_matrix(u2, rows)
    m1, m2 = scaled(g1, scales), scaled(g2, scales)
    normal = factor_normal(g1, g2, scales)
    a, b, c, schur = covariance(m1, m2, normal, camera[16])
    v_x, v_y, v_a, v_b, v_c = _splat_gradient(scratch, a, b, c, schur)
    # Antialiased, opacity is proportional to |normal| / sqrt(schur c).
    v_log = -plane(scratch, SUMS) if camera[17] > _ZERO else broadcast(_ZERO)
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
    v_g1, v_g2 = scaled(v_m1, scales), scaled(v_m2, scales)
    if camera[17] > _ZERO:
        extra, extra1, extra2 = _normal_gradient(v_log, normal, g1, g2, scales)
        v_scales, v_g1, v_g2 = add(v_scales, extra), add(v_g1, extra1), add(v_g2, extra2)
    write_plane(scratch, SCALES, v_scales[0])
    write_plane(scratch, SCALES + 1, v_scales[1])
    write_plane(scratch, SCALES + 2, v_scales[2])
    _write_rotation_gradient(scratch, u1, u2, v_g1, v_g2, quaternion)
    v_u1 = (dot(rows[0], v_g1), dot(rows[1], v_g1), dot(rows[2], v_g1))
    v_u2 = (dot(rows[0], v_g2), dot(rows[1], v_g2), dot(rows[2], v_g2))
    _write_mean_gradient(scratch, point, camera, u1, u2, unclamped_x, unclamped_y, v_u1, v_u2, v_x, v_y)
    write_plane(scratch, OPACITY, -(plane(scratch, SUMS) / opacity))


@kernel
def project_backward_part(
    part, parts, means, rotations, scales, opacities, camera, width, height, bounds, sums,
    v_means, v_rotations, v_scales, v_opacities,
):  # fmt: skip
    """Write the gradients of one part of the Gaussians; those that were not drawn keep what is there."""
    n = len(means)
    width, height = np.float32(width), np.float32(height)
    scratch = np.empty(PLANES * LANES, np.float32)
    end = n * (part + 1) // parts
    for start in range(n * part // parts, end, LANES):
        load_planes(scratch, start, end, means, rotations, scales, opacities)
        for lane in range(LANES):
            for k in range(SUMS_SIZE):
                scratch[(SUMS + k) * LANES + lane] = sums[min(start + lane, end - 1), k]
        _project_backward(scratch, camera, width, height)
        for lane in range(min(LANES, end - start)):
            i = start + lane
            if bounds[i, 1] == 0:
                continue
            for k in range(3):
                v_means[i, k] = scratch[(MEAN + k) * LANES + lane]
                v_scales[i, k] = scratch[(SCALES + k) * LANES + lane]
            for k in range(4):
                v_rotations[i, k] = scratch[(ROTATION + k) * LANES + lane]
            v_opacities[i] = scratch[OPACITY * LANES + lane]
