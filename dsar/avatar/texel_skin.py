"""Bone transforms blended at every texel, and their nearest rotations, in one compiled pass on the CPU.

Of all joints a handful moves a texel, so the others' weights are left out. The same function as
`blend_transforms` and `nearest_quaternions` one after another, the oracle of its tests.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32
from torch import Tensor

from dsar.avatar.posing import find_quaternions
from dsar.raster.jit import kernel
from dsar.raster.simd import LANES, broadcast, load, store

_PADDED, _ZERO = 16, np.float32(0)


@dataclass(frozen=True)
class TexelSkin:
    """The skin weights of texels without their zeros."""

    starts: Int32[np.ndarray, " n1"]
    """Where the weights of each texel start, and where the last one's end."""
    joints: Int32[np.ndarray, " k"]
    """Joint of each weight."""
    weights: Float32[np.ndarray, " k"]
    """Those of a texel sum to 1."""

    @classmethod
    def of_weights(cls, weights: Float[Tensor, "n j"]) -> "TexelSkin":
        """Return the weights that are not 0."""
        dense = weights.detach().cpu().float().numpy()
        texels, joints = dense.nonzero()
        starts = np.searchsorted(texels, np.arange(len(dense) + 1))
        return cls(starts.astype(np.int32), joints.astype(np.int32), dense[texels, joints])

    def blend(
        self, transforms: Float32[Tensor, "b j 4 4"]
    ) -> tuple[Float32[Tensor, "b n 3 4"], Float32[Tensor, "b n 4"]]:
        """Return the blend of joint transforms at each texel, and its nearest rotation (unit wxyz).

        No gradient flows through either.
        """
        # All four rows: the last one, which nobody reads, fills the registers.
        padded = transforms.detach().reshape(len(transforms), -1).contiguous().numpy()
        batch, texels = len(padded), len(self.starts) - 1
        blended = np.empty((batch, texels, 3, 4), np.float32)
        rotations = np.empty((batch, texels, 4), np.float32)
        for entry in range(batch):
            matrices = blended[entry].reshape(-1, 12)
            _blend(self.starts, self.joints, self.weights, padded[entry], matrices, rotations[entry])
        return torch.from_numpy(blended), torch.from_numpy(rotations)


@kernel
def _blend(starts, joints, weights, transforms, blended, rotations):
    """Blend the transforms of every texel; LANES texels at a time go on to their rotations.

    A joint's transform fills _PADDED numbers: one register, or two of half the size.
    """
    count, matrices, row = len(starts) - 1, np.empty(9 * LANES, np.float32), np.empty(_PADDED, np.float32)
    second = np.uint64(_PADDED - LANES)
    for first in range(0, count, LANES):
        for lane in range(LANES):
            # Beyond the end the last texel is written again.
            i = np.uint64(min(first + lane, count - 1))
            low, high = broadcast(_ZERO), broadcast(_ZERO)
            for k in range(np.uint64(starts[i]), np.uint64(starts[i + np.uint64(1)])):
                weight, place = weights[k], np.uint64(_PADDED) * np.uint64(joints[k])
                low += weight * load(transforms, place)
                high += weight * load(transforms, place + second)
            store(row, np.uint64(0), low)
            store(row, second, high)
            for c in range(12):
                blended[i, c] = row[c]
            for r in range(3):
                for c in range(3):
                    matrices[(3 * r + c) * LANES + lane] = row[4 * r + c]
        find_quaternions(matrices)
        for lane in range(min(LANES, count - first)):
            for k in range(4):
                rotations[first + lane, k] = matrices[k * LANES + lane]
