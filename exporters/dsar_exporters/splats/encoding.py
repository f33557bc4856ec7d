"""Gaussians as splat files hold them: logarithms of standard deviations, logits of opacities.

No other room knows logarithms and logits.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from dsar.errors import ExportError
from dsar.types import Gaussians
from dsar_exporters.optional import require

# A scale of zero or an opacity of one is infinite when encoded, which viewers show as giant splats.
_MIN_SCALE = 1e-8
_OPACITY_MARGIN = 1e-6
_HEADER_BYTES = 65536


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


def padded(gaussians: Gaussians, sh_degree: int | None) -> Gaussians:
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


def _check_header(path: Path) -> None:
    """Raise ExportError where a PLY's header does not end: gsply would look for its end forever."""
    try:
        with path.open("rb") as file:
            ends = b"end_header" in file.read(_HEADER_BYTES)
    except OSError as error:
        raise ExportError(f"{path}: expected a compressed PLY, found {error}") from error
    if not ends:
        raise ExportError(f"{path}: expected a compressed PLY, found no end of its header")


def read_splats(path: Path) -> Gaussians:
    """Read a compressed PLY or an SPZ file as physical values in the file's own frame.

    Raises:
        ExportError: The file is missing or is none of them.
        MissingDependencyError: gsply is not installed.
    """
    gsply = require("gsply", feature="compressed PLY and SPZ", package="gsply", extra="ply")
    if path.suffix != ".spz":
        _check_header(path)
    try:
        data = gsply.read_spz(path) if path.suffix == ".spz" else gsply.plyread(path)
    except (OSError, ValueError, KeyError, IndexError, EOFError) as error:
        raise ExportError(f"{path}: expected an SPZ or a compressed PLY, found {error}") from error
    dc = data.sh0[:, None]
    harmonics = dc if data.shN is None else np.concatenate([dc, data.shN.reshape(len(dc), -1, 3)], 1)
    arrays = {
        "means": data.means,
        "log_scales": data.scales,
        "rotations": data.quats,
        "logits": data.opacities,
        "harmonics": harmonics,
    }
    return decode(Encoded(**{name: np.array(values, np.float32) for name, values in arrays.items()}))
