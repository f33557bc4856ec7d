"""Numba kernels: spherical harmonics to the colour of each splat, and the way back.

Same basis, order and signs as dsar.geometry.harmonics. Runs after the projection, on what it left visible.
"""

import math

import numpy as np

from dsar.geometry.harmonics import C0
from dsar.raster.jit import inlined, kernel

_C0, _C1 = np.float32(C0), np.float32(0.4886025119029199)
_C2A, _C2B, _C2C = (
    np.float32(value) for value in (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
)
_C3A, _C3B, _C3C = (
    np.float32(value) for value in (0.5900435899266435, 2.890611442640554, 0.4570457994644658)
)
_C3D, _C3E = np.float32(0.3731763325901154), np.float32(1.445305721320277)
_FLOAT_MAX = np.finfo(np.float32).max
_ZERO, _HALF, _ONE, _TWO, _THREE, _FOUR, _FIVE, _SIX, _TEN, _FIFTEEN = (
    np.float32(value) for value in (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 10.0, 15.0)
)


@inlined
def _fill_basis(basis, x, y, z):
    """Write as many basis values at a unit direction as the array holds (1, 4, 9 or 16)."""
    basis[0] = _C0
    if len(basis) > 1:
        basis[1], basis[2], basis[3] = -_C1 * y, _C1 * z, -_C1 * x
    if len(basis) > 4:
        basis[4], basis[5] = _C2A * x * y, -_C2A * y * z
        basis[6] = _C2B * (_THREE * z * z - _ONE)
        basis[7], basis[8] = -_C2A * x * z, _C2C * (x * x - y * y)
    if len(basis) > 9:
        basis[9] = -_C3A * y * (_THREE * x * x - y * y)
        basis[10] = _C3B * x * y * z
        basis[11] = -_C3C * y * (_FIVE * z * z - _ONE)
        basis[12] = _C3D * z * (_FIVE * z * z - _THREE)
        basis[13] = -_C3C * x * (_FIVE * z * z - _ONE)
        basis[14] = _C3E * z * (x * x - y * y)
        basis[15] = -_C3A * x * (x * x - _THREE * y * y)


@inlined
def _direction_gradient(v, x, y, z):
    """Return the gradient of sum(v * basis) by the direction, the basis taken as polynomials in x, y, z."""
    v_x, v_y, v_z = -_C1 * v[3], -_C1 * v[1], _C1 * v[2]
    if len(v) > 4:
        v_x += _C2A * (y * v[4] - z * v[7]) + _TWO * _C2C * x * v[8]
        v_y += _C2A * (x * v[4] - z * v[5]) - _TWO * _C2C * y * v[8]
        v_z += -_C2A * (y * v[5] + x * v[7]) + _SIX * _C2B * z * v[6]
    if len(v) > 9:
        axial = _FIVE * z * z - _ONE
        v_x += -_SIX * _C3A * x * y * v[9] + _C3B * y * z * v[10] - _C3C * axial * v[13]
        v_x += _TWO * _C3E * x * z * v[14] - _THREE * _C3A * (x * x - y * y) * v[15]
        v_y += -_THREE * _C3A * (x * x - y * y) * v[9] + _C3B * x * z * v[10] - _C3C * axial * v[11]
        v_y += -_TWO * _C3E * y * z * v[14] + _SIX * _C3A * x * y * v[15]
        v_z += _C3B * x * y * v[10] - _TEN * _C3C * z * (y * v[11] + x * v[13])
        v_z += _C3D * (_FIFTEEN * z * z - _THREE) * v[12] + _C3E * (x * x - y * y) * v[14]
    return v_x, v_y, v_z


@inlined
def _direction(means, center, i):
    """Return the direction a Gaussian is seen along and the inverse of its distance."""
    x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
    inverse = _ONE / math.sqrt(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse, inverse


@kernel
def shade_part(part, parts, means, harmonics, center, records, bounds):
    """Write the colours of one part of the records; a colour that is not finite empties the bounds."""
    n, count = len(means), harmonics.shape[1]
    basis = np.empty(count, np.float32)
    basis[0] = _C0
    for i in range(n * part // parts, n * (part + 1) // parts):
        if bounds[i, 1] == 0:
            continue
        if count > 1:
            x, y, z, _ = _direction(means, center, i)
            _fill_basis(basis, x, y, z)
        red, green, blue = _HALF, _HALF, _HALF
        for k in range(count):
            red += basis[k] * harmonics[i, k, 0]
            green += basis[k] * harmonics[i, k, 1]
            blue += basis[k] * harmonics[i, k, 2]
        # Not math.isfinite: it subtracts the value from itself, which the compiler may fold to zero.
        if not abs(red + green + blue) <= _FLOAT_MAX:
            bounds[i, 0] = bounds[i, 1] = bounds[i, 2] = bounds[i, 3] = 0
            continue
        records[i, 6], records[i, 7], records[i, 8] = max(red, _ZERO), max(green, _ZERO), max(blue, _ZERO)


@kernel
def shade_backward_part(part, parts, means, harmonics, center, bounds, sums, v_harmonics, v_means):
    """Write the gradient of the harmonics, and add that of the directions to the means'."""
    n, count = len(means), harmonics.shape[1]
    basis, v_basis = np.empty(count, np.float32), np.empty(count, np.float32)
    basis[0] = _C0
    for i in range(n * part // parts, n * (part + 1) // parts):
        if bounds[i, 1] == 0:
            continue
        x, y, z, inverse = _ZERO, _ZERO, _ZERO, _ZERO
        if count > 1:
            x, y, z, inverse = _direction(means, center, i)
            _fill_basis(basis, x, y, z)
        v_basis[:] = _ZERO
        for channel in range(3):
            value = _HALF
            for k in range(count):
                value += basis[k] * harmonics[i, k, channel]
            v_color = sums[i, 6 + channel] if value >= _ZERO else _ZERO
            for k in range(count):
                v_harmonics[i, k, channel] = basis[k] * v_color
                v_basis[k] += harmonics[i, k, channel] * v_color
        if count == 1:
            continue
        v_x, v_y, v_z = _direction_gradient(v_basis, x, y, z)
        radial = x * v_x + y * v_y + z * v_z
        v_means[i, 0] += (v_x - x * radial) * inverse
        v_means[i, 1] += (v_y - y * radial) * inverse
        v_means[i, 2] += (v_z - z * radial) * inverse
