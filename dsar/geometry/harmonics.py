"""Real spherical harmonics up to degree 3 in the basis, order and signs of 3D Gaussian Splatting.

Coefficients are DC first; a colour is `basis · coefficients + 0.5`, clamped at 0
(Kerbl et al. 2023; same basis as KHR_gaussian_splatting).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.geometry.rotations import matrix_from_quaternion

C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


def harmonics_basis(directions: Float[Tensor, "*b 3"], count: int) -> Float[Tensor, "*b k"]:
    """Return the first `count` (1, 4, 9 or 16) basis values at unit directions."""
    if count not in (1, 4, 9, 16):
        raise ValueError(f"harmonics come in 1, 4, 9 or 16 coefficients (degree 0-3), not {count}")
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, C0)]
    if count > 1:
        basis += [-_C1 * y, _C1 * z, -_C1 * x]
    if count > 4:
        a, b, c = _C2
        basis += [a * x * y, -a * y * z, b * (3 * z * z - 1), -a * x * z, c * (x * x - y * y)]
    if count > 9:
        a, b, c, d, e = _C3
        basis += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (5 * z * z - 1),
            d * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1),
            e * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, -1)


def color_from_harmonics(
    harmonics: Float[Tensor, "n k 3"], directions: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Return colours >= 0 seen along unit directions (camera towards Gaussian)."""
    if harmonics.shape[1] == 1:
        return (harmonics[:, 0] * C0 + 0.5).clamp_min(0)
    basis = harmonics_basis(directions, harmonics.shape[1])
    return (torch.einsum("nk,nkc->nc", basis, harmonics) + 0.5).clamp_min(0)


def dc_from_color(color: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Return the DC coefficient whose view-independent colour is `color`."""
    return (color - 0.5) / C0


def rotate_harmonics(
    harmonics: Float[Tensor, "*b k 3"], quaternions: Float[Tensor, "*b 4"]
) -> Float[Tensor, "*b k 3"]:
    """Return harmonics of the same radiance turned by a rotation (unit quaternion wxyz) per element.

    Each degree is fitted exactly to its values in as many directions as it has coefficients:
    the turned function at d is the original at the direction turned back.
    """
    count = harmonics.shape[-2]
    if count == 1:
        return harmonics
    directions = _probe_directions(harmonics)
    inverse = matrix_from_quaternion(quaternions).mT
    turned = torch.einsum("...ij,dj->...di", inverse, directions)
    fixed_basis, turned_basis = harmonics_basis(directions, count), harmonics_basis(turned, count)
    bands = [harmonics[..., :1, :]]
    for degree in range(1, round(count**0.5)):
        band = slice(degree**2, (degree + 1) ** 2)
        values = turned_basis[..., band] @ harmonics[..., band, :]
        bands.append(torch.linalg.pinv(fixed_basis[:, band]) @ values)
    return torch.cat(bands, -2)


def _probe_directions(like: Tensor) -> Float[Tensor, "16 3"]:
    """Return 16 well-spread unit directions (a Fibonacci lattice)."""
    index = torch.arange(16, dtype=like.dtype, device=like.device) + 0.5
    z, angle = 1 - index / 8, index * (torch.pi * (3 - 5**0.5))
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], -1)
