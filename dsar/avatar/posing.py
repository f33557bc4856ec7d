"""From canonical to posed Gaussians: linear blend skinning with proper rotations (paper equation 4).

The blend of bone transforms moves the centres; its nearest rotation (polar factor) turns the
covariances and the harmonics, in rendering and in every export alike. Neither depends on anything
that is learnt, so the rotation needs no gradient and is computed by a compiled kernel.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.geometry.harmonics import rotate_harmonics
from dsar.geometry.rotations import quaternion_multiply
from dsar.raster.jit import kernel
from dsar.types import Gaussians

_POLAR_STEPS = 6


def pose_gaussians(
    canonical: tuple[Tensor, Tensor, Tensor, Tensor, Tensor], blended: Float[Tensor, "b n 3 4"]
) -> list[Gaussians]:
    """Return one posed set of Gaussians per batch entry from canonical fields (batch of 1 or b).

    Harmonics are rotated with the surface, which is the same as evaluating them along the view
    direction turned back into the canonical frame.
    """
    means, rotations, scales, opacities, harmonics = canonical
    posed_means = (blended[..., :3] * means[..., None, :]).sum(-1) + blended[..., 3]
    turns = nearest_quaternions(blended[..., :3])
    posed_rotations = quaternion_multiply(turns, rotations.expand_as(turns))
    batch = len(blended)
    fields = [f.expand(batch, *f.shape[1:]) for f in (scales, opacities, harmonics)]
    if harmonics.shape[2] > 1:
        fields[2] = rotate_harmonics(fields[2], turns)
    return [
        Gaussians(posed_means[i], posed_rotations[i], fields[0][i], fields[1][i], fields[2][i])
        for i in range(batch)
    ]


def nearest_quaternions(matrices: Float[Tensor, "b n 3 3"]) -> Float[Tensor, "b n 4"]:
    """Return the unit quaternion wxyz of each matrix's nearest rotation; no gradient flows through it."""
    flat = matrices.detach().reshape(-1, 9).float().cpu().contiguous().numpy()
    quaternions = _nearest_quaternions(flat)
    return torch.from_numpy(quaternions).to(matrices).reshape(*matrices.shape[:-2], 4)


@kernel
def _nearest_quaternions(matrices):
    """Polar factor by Newton's iteration R <- (R + R^-T) / 2 (Higham 1986), then Shepperd's quaternion."""
    count = matrices.shape[0]
    result = np.empty((count, 4), np.float32)
    for i in range(count):
        a, b, c = float(matrices[i, 0]), float(matrices[i, 1]), float(matrices[i, 2])
        d, e, f = float(matrices[i, 3]), float(matrices[i, 4]), float(matrices[i, 5])
        g, h, k = float(matrices[i, 6]), float(matrices[i, 7]), float(matrices[i, 8])
        for _ in range(_POLAR_STEPS):
            # Cofactors over the determinant are the inverse transpose.
            ca, cb, cc = e * k - f * h, f * g - d * k, d * h - e * g
            cd, ce, cf = c * h - b * k, a * k - c * g, b * g - a * h
            cg, ch, ck = b * f - c * e, c * d - a * f, a * e - b * d
            inverse = 0.5 / (a * ca + b * cb + c * cc)
            a, b, c = 0.5 * a + ca * inverse, 0.5 * b + cb * inverse, 0.5 * c + cc * inverse
            d, e, f = 0.5 * d + cd * inverse, 0.5 * e + ce * inverse, 0.5 * f + cf * inverse
            g, h, k = 0.5 * g + cg * inverse, 0.5 * h + ch * inverse, 0.5 * k + ck * inverse
        ww, xx, yy, zz = 1 + a + e + k, 1 + a - e - k, 1 - a + e - k, 1 - a - e + k
        if ww >= xx and ww >= yy and ww >= zz:
            w, x, y, z = ww, h - f, c - g, d - b
        elif xx >= yy and xx >= zz:
            w, x, y, z = h - f, xx, b + d, c + g
        elif yy >= zz:
            w, x, y, z = c - g, b + d, yy, f + h
        else:
            w, x, y, z = d - b, c + g, f + h, zz
        norm = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
        if w < 0:
            norm = -norm
        result[i, 0], result[i, 1], result[i, 2], result[i, 3] = w * norm, x * norm, y * norm, z * norm
    return result
