"""Gaussians as splat files hold them: logarithms of standard deviations, logits of opacities.

No other room knows logarithms and logits.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32

from dsar.errors import ExportError
from dsar.types import Gaussians

# A scale of zero or an opacity of one is infinite when encoded, which viewers show as giant splats.
_MIN_SCALE = 1e-8
_OPACITY_MARGIN = 1e-6


@dataclass(frozen=True)
class Encoded:
    """Gaussians in the values of Kerbl et al. 2023's files."""

    means: Float32[np.ndarray, "n 3"]
    log_scales: Float32[np.ndarray, "n 3"]
    rotations: Float32[np.ndarray, "n 4"]
    """Unit quaternions wxyz."""
    logits: Float32[np.ndarray, " n"]
    harmonics: Float32[np.ndarray, "n k 3"]


def encode(gaussians: Gaussians) -> Encoded:
    """Return Gaussians encoded; scales below 1e-8 m and opacities within 1e-6 of 0 and 1 move there."""
    opacity = gaussians.opacities.clamp(_OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    return Encoded(
        means=gaussians.means.numpy(),
        log_scales=gaussians.scales.clamp_min(_MIN_SCALE).log().numpy(),
        rotations=gaussians.rotations.numpy(),
        logits=opacity.logit().numpy(),
        harmonics=gaussians.harmonics.numpy(),
    )


def decode(encoded: Encoded) -> Gaussians:
    """Return physical values; quaternions are normalised."""
    quaternions = torch.from_numpy(encoded.rotations)
    return Gaussians(
        means=torch.from_numpy(encoded.means),
        rotations=torch.nn.functional.normalize(quaternions, dim=-1),
        scales=torch.from_numpy(encoded.log_scales).exp(),
        opacities=torch.from_numpy(encoded.logits).sigmoid(),
        harmonics=torch.from_numpy(encoded.harmonics),
    )


def pad_harmonics(gaussians: Gaussians, sh_degree: int | None) -> Gaussians:
    """Return the Gaussians with harmonics extended by zeros, never cut, to a degree.

    Raises:
        ExportError: They have more.
    """
    missing = 0 if sh_degree is None else (sh_degree + 1) ** 2 - gaussians.harmonics.shape[1]
    if missing < 0:
        raise ExportError(
            f"sh_degree: expected at least the degree of the sequence, found {sh_degree} for "
            f"{gaussians.harmonics.shape[1]} harmonics: cutting them would change the colours"
        )
    harmonics = torch.nn.functional.pad(gaussians.harmonics, (0, 0, 0, missing))
    return Gaussians(gaussians.means, gaussians.rotations, gaussians.scales, gaussians.opacities, harmonics)
