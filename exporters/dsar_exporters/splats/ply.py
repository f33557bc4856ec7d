"""3D Gaussian Splatting PLY sequences, readable by every splat viewer.

The layout is the one of Kerbl et al. 2023: one binary little-endian element `vertex`, float32 properties
`x y z nx ny nz f_dc_* f_rest_* opacity scale_* rot_*`, with the logarithm of the standard deviation, the
logit of the opacity, the quaternion wxyz, and f_rest channel-major (all red, then green, then blue).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dsar.errors import ExportError
from dsar.types import Gaussians, GaussianSequence
from dsar_exporters.delivery import export
from dsar_exporters.optional import require
from dsar_exporters.splats.encoding import Encoded, encode, pad_harmonics
from dsar_exporters.splats.files import SplatSequence


def write_ply(
    sequence: GaussianSequence, folder: Path, *, name: str, sh_degree: int | None = None
) -> list[Path]:
    """Write one PLY per frame, `<name>.<frame, 4 digits>.ply`, and return the paths in frame order.

    World metres, Y up; colours display-referred sRGB. Header comments carry frame, rate, units, axes,
    colour space and provenance. Each file appears when it is complete; those of earlier frames stay if a
    later frame fails. Scales below 1e-8 m and opacities within 1e-6 of 0 and 1 are moved to these limits.

    Args:
        sequence: The frames, produced once and one at a time.
        folder: Where the files go; made if missing.
        name: First part of the file names.
        sh_degree: Pad the harmonics with zeros to this degree (0-3), for viewers that insist on one;
            None keeps the degree of the sequence.

    Raises:
        ExportError: The name cannot be part of a file name, or the sequence is not fit for export.
        MissingDependencyError: plyfile is not installed.
    """
    output = PlySequence(folder, name, sh_degree=sh_degree)
    export(sequence, [output])
    return [output.frame_path(frame) for frame in sequence.frame_numbers]


@dataclass(frozen=True)
class PlySequence(SplatSequence):
    """One PLY a frame; see `write_ply`."""

    sh_degree: int | None = None
    """Pad the harmonics with zeros to this degree."""

    suffix: ClassVar[str] = ".ply"

    def check(self) -> None:
        """Raise where the degree is none, or plyfile is not installed."""
        if self.sh_degree is not None and self.sh_degree not in range(4):
            raise ExportError(f"PLY sh_degree: expected 0, 1, 2 or 3, found {self.sh_degree}")
        require_plyfile()

    def write_frame(self, draft: Path, gaussians: Gaussians, sequence: GaussianSequence, frame: int) -> None:
        """Write one frame."""
        plyfile = require_plyfile()
        vertices = _records(encode(pad_harmonics(gaussians, self.sh_degree)))
        element = plyfile.PlyElement.describe(vertices, "vertex")
        plyfile.PlyData([element], byte_order="<", comments=_comments(sequence, frame)).write(draft)

    def estimated_bytes(self, first: Gaussians, frames: int) -> int:
        """Return how large the files will be; see `Output`."""
        count = first.harmonics.shape[1] if self.sh_degree is None else (self.sh_degree + 1) ** 2
        return frames * len(first) * 4 * len(property_names(count))


def require_plyfile() -> Any:
    """Return the library of PLY files, or raise MissingDependencyError."""
    return require("plyfile", feature="PLY", package="plyfile", extra="ply")


def property_names(harmonics_count: int) -> list[str]:
    """Return the property names in file order for 1, 4, 9 or 16 harmonics."""
    groups = {"f_dc": 3, "f_rest": 3 * (harmonics_count - 1)}
    names = ["x", "y", "z", "nx", "ny", "nz"]
    names += [f"{group}_{i}" for group, size in groups.items() for i in range(size)]
    return [*names, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def _records(encoded: Encoded) -> np.ndarray:
    """Return the records of the element `vertex`."""
    rows, count = encoded.harmonics.shape[:2]
    columns = [
        encoded.means,
        np.zeros_like(encoded.means),
        encoded.harmonics[:, 0],
        encoded.harmonics[:, 1:].transpose(0, 2, 1).reshape(rows, 3 * (count - 1)),
        encoded.logits[:, None],
        encoded.log_scales,
        encoded.rotations,
    ]
    dtype = np.dtype([(field, "<f4") for field in property_names(count)])
    return np.concatenate(columns, 1).astype("<f4", copy=False).reshape(-1).view(dtype)


def _comments(sequence: GaussianSequence, frame: int) -> list[str]:
    """Return the header comments of a frame, those that readers parse first."""
    notes: Mapping[str, object] = {
        **sequence.provenance,
        "frame": frame,
        "fps": f"{sequence.fps:g}",
        "units": "m",
        "colorspace": "srgb_rec709_display",
    }
    # Brush takes three numbers literally, but reads the letter y as minus y.
    standard = ["SplatRenderMode: default", "Vertical axis: 0 1 0"]
    lines = [" ".join(f"dsar.{key} {value}".split()) for key, value in notes.items()]
    return standard + [line.encode("ascii", "backslashreplace").decode() for line in lines]
