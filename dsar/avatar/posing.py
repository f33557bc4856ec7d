"""From canonical to posed Gaussians: linear blend skinning with proper rotations.

The blend of bone transforms moves the centres; its nearest rotation (polar factor) rotates the
covariances and the harmonics, in rendering and in every export alike. Neither depends on anything
that is learnt, so the rotation needs no gradient and is computed by a compiled kernel.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.devices import takes_kernels
from dsar.geometry.harmonics import rotate_harmonics
from dsar.geometry.rotations import quaternion_from_matrix, quaternion_multiply
from dsar.raster.jit import inlined, kernel
from dsar.raster.simd import LANES, planes, select, sqrt, write_plane
from dsar.types import Gaussians

_POLAR_STEPS = 6
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)


def pose_gaussians(
    canonical: tuple[Tensor, Tensor, Tensor, Tensor, Tensor], blended: Float[Tensor, "b n 3 4"]
) -> list[Gaussians]:
    """Return one posed set of Gaussians per batch entry from canonical fields of 1 or b (paper equation 3).

    Harmonics are rotated with the surface, which is the same as evaluating them along the view
    direction turned back into the canonical frame.
    """
    means, rotations, scales, opacities, harmonics = canonical
    posed_means = (blended[..., :3] * means[..., None, :]).sum(-1) + blended[..., 3]
    bone_rotations = nearest_quaternions(blended[..., :3])
    posed_rotations = quaternion_multiply(bone_rotations, rotations.expand_as(bone_rotations))
    batch = len(blended)
    fields = [f.expand(batch, *f.shape[1:]) for f in (scales, opacities, harmonics)]
    if harmonics.shape[2] > 1:
        fields[2] = rotate_harmonics(fields[2], bone_rotations)
    parts = (field.unbind() for field in (posed_means, posed_rotations, *fields))
    return [Gaussians(*own) for own in zip(*parts, strict=True)]


def nearest_quaternions(matrices: Float[Tensor, "b n 3 3"]) -> Float[Tensor, "b n 4"]:
    """Return the unit quaternion wxyz of each matrix's nearest rotation; no gradient flows through it."""
    flat = matrices.detach().reshape(-1, 9)
    if not takes_kernels(flat):
        return _nearest_quaternions_plain(flat).reshape(*matrices.shape[:-2], 4)
    quaternions = _nearest_quaternions(flat.float().contiguous().numpy())
    return torch.from_numpy(quaternions).to(matrices).reshape(*matrices.shape[:-2], 4)


def _nearest_quaternions_plain(matrices: Float[Tensor, "n 9"]) -> Float[Tensor, "n 4"]:
    """Return the same in plain torch, on any device."""
    R = matrices.reshape(-1, 3, 3)
    for _ in range(_POLAR_STEPS):
        rows = R.unbind(1)
        cofactors = torch.stack([torch.linalg.cross(rows[i - 2], rows[i - 1]) for i in range(3)], 1)
        determinant = (rows[0] * cofactors[:, 0]).sum(-1)[:, None, None]
        R = 0.5 * (R + cofactors / determinant)
    return quaternion_from_matrix(R)


@kernel
def _nearest_quaternions(matrices):
    """Return each matrix's nearest rotation as a quaternion; LANES of them go through at a time."""
    count = len(matrices)
    result, scratch = np.empty((count, 4), np.float32), np.empty(9 * LANES, np.float32)
    for start in range(0, count, LANES):
        for lane in range(LANES):
            for k in range(9):
                scratch[k * LANES + lane] = matrices[min(start + lane, count - 1), k]
        find_quaternions(scratch)
        for lane in range(min(LANES, count - start)):
            for k in range(4):
                result[start + lane, k] = scratch[k * LANES + lane]
    return result


@inlined
def find_quaternions(scratch):
    """Replace matrices by quaternions: Newton's R <- (R + R^-T) / 2 (Higham 1986), then Shepperd's method."""
    a, b, c = planes(scratch, 0)
    d, e, f = planes(scratch, 3)
    g, h, k = planes(scratch, 6)
    for _ in range(_POLAR_STEPS):
        # Cofactors over the determinant are the inverse transpose.
        ca, cb, cc = e * k - f * h, f * g - d * k, d * h - e * g
        cd, ce, cf = c * h - b * k, a * k - c * g, b * g - a * h
        cg, ch, ck = b * f - c * e, c * d - a * f, a * e - b * d
        inverse = _HALF / (a * ca + b * cb + c * cc)
        a, b, c = _HALF * a + ca * inverse, _HALF * b + cb * inverse, _HALF * c + cc * inverse
        d, e, f = _HALF * d + cd * inverse, _HALF * e + ce * inverse, _HALF * f + cf * inverse
        g, h, k = _HALF * g + cg * inverse, _HALF * h + ch * inverse, _HALF * k + ck * inverse
    ww, xx, yy, zz = a + e + k + _ONE, a - e - k + _ONE, e - a - k + _ONE, k - a - e + _ONE
    # Whichever is largest has the most digits, and the others follow from it.
    from_w, from_x, from_y = (ww >= xx) & (ww >= yy) & (ww >= zz), (xx >= yy) & (xx >= zz), yy >= zz
    w = select(from_w, ww, select(from_x, h - f, select(from_y, c - g, d - b)))
    x = select(from_w, h - f, select(from_x, xx, select(from_y, b + d, c + g)))
    y = select(from_w, c - g, select(from_x, b + d, select(from_y, yy, f + h)))
    z = select(from_w, d - b, select(from_x, c + g, select(from_y, f + h, zz)))
    norm = _ONE / sqrt(w * w + x * x + y * y + z * z)
    norm = select(w < _ZERO, -norm, norm)
    for plane, value in enumerate((w, x, y, z)):
        write_plane(scratch, plane, value * norm)
