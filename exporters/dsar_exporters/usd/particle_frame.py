"""One frame of Gaussians as the arrays that USD's prims hold."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float16, Float32

from dsar.color import linear_from_srgb
from dsar.geometry.harmonics import C0
from dsar.types import Gaussians

EXTENT_SIGMAS = 3.0
_MIN_SCALE = np.float32(1e-8)
"""Metres: the schema has no Gaussians without extent."""


@dataclass(frozen=True)
class ParticleFrame:
    """Everything that one frame's prims hold of the Gaussians, as arrays in USD's order."""

    means: Float32[np.ndarray, "n 3"]
    xyzw: Float32[np.ndarray, "n 4"]
    """Quaternions as Vt's buffers hold them."""
    half_xyzw: Float16[np.ndarray, "n 4"]
    velocities: Float32[np.ndarray, "n 3"]
    """Metres per second."""
    scales: Float32[np.ndarray, "n 3"]
    opacities: Float32[np.ndarray, " n"]
    harmonics: Float32[np.ndarray, "n k 3"]
    colors: Float32[np.ndarray, "n 3"]
    """Linear, without what depends on the view."""
    extents: Float32[np.ndarray, "n 3"]
    """How far three standard deviations extend along the world's axes, metres."""

    @classmethod
    def from_gaussians(
        cls, gaussians: Gaussians, velocities: Float32[torch.Tensor, "n 3"]
    ) -> "ParticleFrame":
        """Return a frame's arrays."""
        xyzw = gaussians.rotations[:, [1, 2, 3, 0]].numpy()
        dc = gaussians.harmonics[:, 0].numpy()
        return cls(
            means=gaussians.means.numpy(),
            xyzw=xyzw,
            half_xyzw=xyzw.astype(np.float16),
            velocities=velocities.contiguous().numpy(),
            scales=np.maximum(gaussians.scales.numpy(), _MIN_SCALE),
            opacities=gaussians.opacities.numpy(),
            harmonics=gaussians.harmonics.numpy(),
            colors=linear_from_srgb(dc * np.float32(C0) + np.float32(0.5)),
            extents=axis_extents(gaussians.rotations.numpy(), gaussians.scales.numpy()),
        )

    def bounds(self) -> Float32[np.ndarray, "2 3"]:
        """Return the lower and upper corner, metres, of all Gaussians out to three standard deviations."""
        if not len(self.means):
            return np.zeros((2, 3), np.float32)
        return np.stack([(self.means - self.extents).min(0), (self.means + self.extents).max(0)])


def axis_extents(
    rotations: Float32[np.ndarray, "n 4"], scales: Float32[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Return how far three standard deviations extend along the world's axes, metres; quaternions are wxyz.

    The square of a standard deviation along an axis is the sum of squares of a row of R S.
    """
    w, x, y, z = rotations.T
    a, b, c = scales.T
    rows = (
        ((1 - 2 * (y * y + z * z)) * a, 2 * (x * y - w * z) * b, 2 * (x * z + w * y) * c),
        (2 * (x * y + w * z) * a, (1 - 2 * (x * x + z * z)) * b, 2 * (y * z - w * x) * c),
        (2 * (x * z - w * y) * a, 2 * (y * z + w * x) * b, (1 - 2 * (x * x + y * y)) * c),
    )
    squares = [p * p + q * q + r * r for p, q, r in rows]
    return np.float32(EXTENT_SIGMAS) * np.sqrt(np.stack(squares, -1))
