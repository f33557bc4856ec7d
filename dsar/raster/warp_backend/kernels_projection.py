"""Warp kernels: Gaussians in the world to splats on the images. Warp derives the way back.

A splat's record is mean x, mean y, stretch, shear, height, log opacity, red, green, blue and z. Its fall-off
is the Cholesky factor of its inverse covariance: with d = mean - pixel,

    e1 = stretch dx - shear dy,  e2 = height dy,  log alpha = log opacity - e1² - e2².

Unlike the conic (a, b, c) this cannot turn negative by rounding, however thin the splat.

A thread takes one Gaussian through all views of its set, so that no two threads add to the same gradient.
"""

from typing import no_type_check

import warp as wp  # pyright: ignore[reportMissingImports]  # optional

from dsar.raster.conventions import ALPHA_MIN, FRUSTUM_MARGIN, NEAR
from dsar.raster.warp_backend.compiling import differentiable_kernel, func, kernel
from dsar.raster.warp_backend.tables import (
    CENTER,
    FIRST_GAUSSIAN,
    FIRST_INSTANCE,
    FOCAL,
    HEIGHT,
    PRINCIPAL,
    ROTATION,
    TRANSLATION,
    WIDTH,
)

RECORD_SIZE = 10
"""Numbers in a splat's record."""
Record = wp.types.vector(length=RECORD_SIZE, dtype=wp.float32)
Shape = wp.types.vector(length=6, dtype=wp.float32)

_NEAR = wp.constant(NEAR)
_ALPHA_MIN = wp.constant(ALPHA_MIN)
_MARGIN = wp.constant(0.5 * FRUSTUM_MARGIN)

_C0, _C1 = wp.constant(0.28209479177387814), wp.constant(0.4886025119029199)
_C2A, _C2B, _C2C = map(wp.constant, (1.0925484305920792, 0.31539156525252005, 0.5462742152960396))
_C3A, _C3B, _C3C = map(wp.constant, (0.5900435899266435, 2.890611442640554, 0.4570457994644658))
_C3D, _C3E = map(wp.constant, (0.3731763325901154, 1.445305721320277))


@func
@no_type_check
def row(table: wp.array2d[float], view: int, start: int):
    """Return three consecutive numbers of a view's row."""
    return wp.vec3(table[view, start], table[view, start + 1], table[view, start + 2])


@func
@no_type_check
def camera_point(mean: wp.vec3, cameras: wp.array2d[float], view: int):
    """Return a point in camera coordinates, metres."""
    rotated = wp.vec3(
        wp.dot(row(cameras, view, ROTATION), mean),
        wp.dot(row(cameras, view, ROTATION + 3), mean),
        wp.dot(row(cameras, view, ROTATION + 6), mean),
    )
    return rotated + row(cameras, view, TRANSLATION)


@func
@no_type_check
def image_axis(point: wp.vec3, size: int, axis: int, cameras: wp.array2d[float], view: int):
    """Return d(pixel x or y)/d(world), linearised at the point, held inside the widened image."""
    focal, center = cameras[view, FOCAL + axis], cameras[view, PRINCIPAL + axis]
    margin = _MARGIN * float(size) / focal
    tangent = point[axis] / point[2]
    tangent = wp.clamp(tangent, -center / focal - margin, (float(size) - center) / focal + margin)
    across, forward = row(cameras, view, ROTATION + 3 * axis), row(cameras, view, ROTATION + 6)
    return (across - forward * tangent) * (focal / point[2])


@func
@no_type_check
def rotation_matrix(q: wp.vec4):
    """Return the matrix of a quaternion wxyz, which need not be normalised."""
    u = q / wp.sqrt(wp.dot(q, q))
    w, x, y, z = u[0], u[1], u[2], u[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@func
@no_type_check
def project(
    mean: wp.vec3, rotation: wp.vec4, scales: wp.vec3, opacity: float,
    views: wp.array2d[int], cameras: wp.array2d[float], view: int, dilation: float, antialiased: int,
):  # fmt: skip
    """Return a Gaussian's mean x, mean y, stretch, shear and height, and its opacity on the image.

    The determinant before dilation is that of a cross product's square; unlike A C - B² it keeps its digits
    for thin splats.
    """
    point = camera_point(mean, cameras, view)
    axes = wp.transpose(rotation_matrix(rotation))
    g1 = axes * image_axis(point, views[view, WIDTH], 0, cameras, view)
    g2 = axes * image_axis(point, views[view, HEIGHT], 1, cameras, view)
    m1, m2, w = wp.cw_mul(g1, scales), wp.cw_mul(g2, scales), wp.cross(g1, g2)
    normal = wp.vec3(scales[1] * scales[2] * w[0], scales[2] * scales[0] * w[1], scales[0] * scales[1] * w[2])
    a, b, c = wp.dot(m1, m1), wp.dot(m1, m2), wp.dot(m2, m2)
    before = wp.dot(normal, normal)
    determinant = before + dilation * (a + c) + dilation * dilation
    c = c + dilation
    schur = determinant / c
    seen = opacity
    if antialiased != 0:
        seen = opacity * wp.sqrt(before / determinant)
    stretch = wp.sqrt(0.5 / schur)
    x = cameras[view, FOCAL] * (point[0] / point[2]) + cameras[view, PRINCIPAL]
    y = cameras[view, FOCAL + 1] * (point[1] / point[2]) + cameras[view, PRINCIPAL + 1]
    return Shape(x, y, stretch, stretch * b / c, wp.sqrt(0.5 / c), seen)


@func
@no_type_check
def shade(mean: wp.vec3, harmonics: wp.array2d[wp.vec3], g: int, cameras: wp.array2d[float], view: int):
    """Return the colour of a Gaussian: basis, order and signs are dsar.geometry.harmonics'."""
    color = harmonics[g, 0] * _C0
    count = harmonics.shape[1]
    if count > 1:
        d = wp.normalize(mean - row(cameras, view, CENTER))
        x, y, z = d[0], d[1], d[2]
        color = (
            color + harmonics[g, 2] * (_C1 * z) - harmonics[g, 1] * (_C1 * y) - harmonics[g, 3] * (_C1 * x)
        )
        if count > 4:
            color = color + harmonics[g, 4] * (_C2A * x * y) - harmonics[g, 5] * (_C2A * y * z)
            color = color + harmonics[g, 6] * (_C2B * (3.0 * z * z - 1.0)) - harmonics[g, 7] * (_C2A * x * z)
            color = color + harmonics[g, 8] * (_C2C * (x * x - y * y))
        if count > 9:
            axial = 5.0 * z * z
            color = color - harmonics[g, 9] * (_C3A * y * (3.0 * x * x - y * y))
            color = color + harmonics[g, 10] * (_C3B * x * y * z)
            color = color - harmonics[g, 11] * (_C3C * y * (axial - 1.0))
            color = color + harmonics[g, 12] * (_C3D * z * (axial - 3.0))
            color = color - harmonics[g, 13] * (_C3C * x * (axial - 1.0))
            color = color + harmonics[g, 14] * (_C3E * z * (x * x - y * y))
            color = color - harmonics[g, 15] * (_C3A * x * (x * x - 3.0 * y * y))
    return wp.max(color + wp.vec3(0.5, 0.5, 0.5), wp.vec3(0.0, 0.0, 0.0))


@kernel
@no_type_check
def find_drawable(
    means: wp.array[wp.vec3], rotations: wp.array[wp.vec4], scales: wp.array[wp.vec3],
    opacities: wp.array[float], harmonics: wp.array2d[wp.vec3], set_ends: wp.array[int],
    first_views: wp.array[int], views: wp.array2d[int], cameras: wp.array2d[float],
    dilation: float, antialiased: int, drawable: wp.array[int],
):  # fmt: skip
    """Mark instances in front, visible, of positive scale, and finite in all they project to.

    A kernel of its own: were it part of the next, infinities would come back through zero gradients as NaN.
    """
    g = wp.tid()
    owner = wp.lower_bound(set_ends, g + 1)
    q, s = rotations[g], scales[g]
    norm = wp.dot(q, q)
    sound = wp.isfinite(means[g]) and wp.isfinite(1.0 / norm) and norm > 0.0 and wp.isfinite(norm)
    sound = sound and wp.min(wp.min(s[0], s[1]), s[2]) > 0.0 and wp.isfinite(s)
    for k in range(harmonics.shape[1]):
        sound = sound and wp.isfinite(harmonics[g, k])
    for view in range(first_views[owner], first_views[owner + 1]):
        splat = project(means[g], q, s, opacities[g], views, cameras, view, dilation, antialiased)
        z = camera_point(means[g], cameras, view)[2]
        drawn = sound and z > _NEAR and splat[2] > 0.0 and splat[4] > 0.0 and splat[5] >= _ALPHA_MIN
        drawn = drawn and wp.isfinite(splat) and wp.isfinite(z)
        instance = views[view, FIRST_INSTANCE] + g - views[view, FIRST_GAUSSIAN]
        drawable[instance] = wp.where(drawn, 1, 0)


@differentiable_kernel
@no_type_check
def make_records(
    means: wp.array[wp.vec3], rotations: wp.array[wp.vec4], scales: wp.array[wp.vec3],
    opacities: wp.array[float], harmonics: wp.array2d[wp.vec3], set_ends: wp.array[int],
    first_views: wp.array[int], views: wp.array2d[int], cameras: wp.array2d[float],
    dilation: float, antialiased: int, drawable: wp.array[int], records: wp.array[Record],
):  # fmt: skip
    """Write the records of instances that are drawable."""
    g = wp.tid()
    owner = wp.lower_bound(set_ends, g + 1)
    for view in range(first_views[owner], first_views[owner + 1]):
        instance = views[view, FIRST_INSTANCE] + g - views[view, FIRST_GAUSSIAN]
        if drawable[instance] != 0:
            splat = project(
                means[g], rotations[g], scales[g], opacities[g],
                views, cameras, view, dilation, antialiased,
            )  # fmt: skip
            color = shade(means[g], harmonics, g, cameras, view)
            z = camera_point(means[g], cameras, view)[2]
            records[instance] = Record(
                splat[0], splat[1], splat[2], splat[3], splat[4], wp.log(splat[5]),
                color[0], color[1], color[2], z,
            )  # fmt: skip
