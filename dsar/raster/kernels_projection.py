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

from dsar.raster.conventions import ALPHA_MIN, NEAR
from dsar.raster.jit import inlined, kernel
from dsar.raster.projection_geometry import (
    BOUNDS,
    MEAN,
    OPACITY,
    PLANES,
    SCALES,
    camera_point,
    covariance,
    dot,
    factor_normal,
    image_axes,
    load_planes,
    rotation_rows,
    scaled,
    times_matrix,
    unit_quaternion,
)
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

_NEAR = np.float32(NEAR)
_ALPHA_MIN = np.float32(ALPHA_MIN)
_LOG_ALPHA_MIN = np.float32(math.log2(ALPHA_MIN))
_LOG2_E, _LN2 = np.float32(math.log2(math.e)), np.float32(math.log(2))
_FLOAT_MAX = np.finfo(np.float32).max
_ZERO, _HALF, _TWO = np.float32(0.0), np.float32(0.5), np.float32(2.0)


@inlined
def _pixel_range(center, radius, size):
    """Return the first and end index of the pixels whose centres lie within a radius, inside the image."""
    first, end = -floor(radius + _HALF - center), floor(center + radius + _HALF)
    low, high = broadcast(_ZERO), broadcast(size)
    return minimum(maximum(first, low), high), minimum(maximum(end, low), high)


@inlined
def _project(scratch, camera, width, height):
    """Replace Gaussians in the scratch planes by their records and bounds."""
    mean, scales, opacity = planes(scratch, MEAN), planes(scratch, SCALES), plane(scratch, OPACITY)
    point = camera_point(mean, camera)
    w, x, y, z, inverse = unit_quaternion(scratch)
    rows = rotation_rows(w, x, y, z)
    u1, u2, _, _ = image_axes(point, camera, width, height)
    g1, g2 = times_matrix(u1, rows), times_matrix(u2, rows)
    normal = factor_normal(g1, g2, scales)
    a, b, c, schur = covariance(scaled(g1, scales), scaled(g2, scales), normal, camera[16])
    if camera[17] > _ZERO:
        opacity = opacity * sqrt(dot(normal, normal) / (schur * c))
    mean_x = camera[12] * point[0] / point[2] + camera[14]
    mean_y = camera[13] * point[1] / point[2] + camera[15]
    log_opacity = log2(opacity)
    # Alpha is at least ALPHA_MIN within this many variances, squared, of the mean.
    cutoff = (_TWO * _LN2) * (log_opacity - _LOG_ALPHA_MIN) + np.float32(1e-4)
    x0, x1 = _pixel_range(mean_x, sqrt(cutoff * a), width)
    y0, y1 = _pixel_range(mean_y, sqrt(cutoff * c), height)
    # Comparisons with NaN fail, and so does one with an infinite or NaN sum.
    finite = mean_x + mean_y + point[2] + a + c + schur + opacity
    valid = (finite <= _FLOAT_MAX) & (finite >= -_FLOAT_MAX)
    # A quaternion whose square overflows has no inverse norm.
    valid = valid & (inverse > _ZERO) & (minimum(minimum(scales[0], scales[1]), scales[2]) > _ZERO)
    drawn = valid & (point[2] > _NEAR) & (opacity >= _ALPHA_MIN) & (x0 < x1) & (y0 < y1)
    stretch = sqrt(_HALF * _LOG2_E / schur)
    write_plane(scratch, 0, mean_x)
    write_plane(scratch, 1, mean_y)
    write_plane(scratch, 2, stretch)
    write_plane(scratch, 3, stretch * b / c)
    write_plane(scratch, 4, sqrt(_HALF * _LOG2_E / c))
    write_plane(scratch, 5, log_opacity)
    write_plane(scratch, 9, point[2])
    write_plane(scratch, 10, sqrt(cutoff * c))
    write_plane(scratch, 11, b * sqrt(cutoff / a))
    nothing = broadcast(_ZERO)
    write_plane(scratch, BOUNDS, select(drawn, x0, nothing))
    write_plane(scratch, BOUNDS + 1, select(drawn, x1, nothing))
    write_plane(scratch, BOUNDS + 2, select(drawn, y0, nothing))
    write_plane(scratch, BOUNDS + 3, select(drawn, y1, nothing))


@kernel
def project_part(part, parts, means, rotations, scales, opacities, camera, width, height, records, bounds):
    """Write the records (all but colours) and bounds of one part of the Gaussians."""
    n = len(means)
    width, height = np.float32(width), np.float32(height)
    scratch = np.empty(PLANES * LANES, np.float32)
    end = n * (part + 1) // parts
    for start in range(n * part // parts, end, LANES):
        load_planes(scratch, start, end, means, rotations, scales, opacities)
        _project(scratch, camera, width, height)
        for lane in range(min(LANES, end - start)):
            for k in range(BOUNDS):
                records[start + lane, k] = scratch[k * LANES + lane]
            for k in range(4):
                bounds[start + lane, k] = np.int32(scratch[(BOUNDS + k) * LANES + lane])
