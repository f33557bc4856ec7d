"""Small splat files, written by gsply: PlayCanvas's compressed PLY and Niantic's SPZ."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dsar.types import Gaussians, GaussianSequence
from dsar_exporters.optional import require
from dsar_exporters.splats.encoding import encode
from dsar_exporters.splats.files import SplatSequence

_COMPRESSED_BYTES = 16.3
"""Of a Gaussian without higher harmonics, its share of the chunks with it."""
_SPZ_BYTES, _SPZ_HARMONIC_BYTES = 16, 0.3
"""Of a Gaussian without higher harmonics, and of one of these: about, since an SPZ is compressed."""


@dataclass(frozen=True)
class CompressedPlySequence(SplatSequence):
    """PlayCanvas's compressed PLY: 16 bytes a Gaussian, positions to 11 bits within chunks of 256 Gaussians.

    Chunks are cut in the order of the Gaussians, which keep it here; converters to this format reorder.
    """

    suffix: ClassVar[str] = ".compressed.ply"

    def check(self) -> None:
        """Raise MissingDependencyError where gsply is not installed."""
        _require_gsply("compressed PLY")

    def write_frame(self, draft: Path, gaussians: Gaussians, sequence: GaussianSequence, frame: int) -> None:
        """Write one frame."""
        written = draft.with_name("draft.compressed.ply")
        _require_gsply("compressed PLY").plywrite(written, _data(gaussians), compressed=True)
        written.replace(draft)

    def estimated_bytes(self, first: Gaussians, frames: int) -> int:
        """Return how large the files will be; see `Output`."""
        higher = 3 * (first.harmonics.shape[1] - 1)
        return round(frames * len(first) * (_COMPRESSED_BYTES + higher))


@dataclass(frozen=True)
class SpzSequence(SplatSequence):
    """SPZ version 3, which all its readers know: positions to 0.24 mm, standard deviations to 3 %.

    Its own axes are x right, y up, z back, as ours and glTF's are, so that no axis changes. Gaussians keep
    their order.
    """

    suffix: ClassVar[str] = ".spz"

    def check(self) -> None:
        """Raise MissingDependencyError where gsply is not installed."""
        _require_gsply("SPZ")

    def write_frame(self, draft: Path, gaussians: Gaussians, sequence: GaussianSequence, frame: int) -> None:
        """Write one frame."""
        _require_gsply("SPZ").write_spz(draft, _data(gaussians))

    def estimated_bytes(self, first: Gaussians, frames: int) -> int:
        """Return how large the files will be; see `Output`."""
        higher = 3 * (first.harmonics.shape[1] - 1)
        return round(frames * len(first) * (_SPZ_BYTES + _SPZ_HARMONIC_BYTES * higher))


def _require_gsply(feature: str) -> Any:
    return require("gsply", feature=feature, package="gsply", extra="ply")


def _data(gaussians: Gaussians) -> Any:
    """Return Gaussians as gsply takes them."""
    encoded = encode(gaussians)
    return _require_gsply("splat files").GSData(
        means=encoded.means,
        scales=encoded.log_scales,
        quats=encoded.rotations,
        opacities=encoded.logits,
        sh0=np.ascontiguousarray(encoded.harmonics[:, 0]),
        shN=np.ascontiguousarray(encoded.harmonics[:, 1:]),
    )
