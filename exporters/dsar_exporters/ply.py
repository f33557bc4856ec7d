"""3D Gaussian Splatting PLY sequences, readable by every splat viewer.

The layout is the one of Kerbl et al. 2023: one binary little-endian element `vertex`, float32 properties
`x y z nx ny nz f_dc_* f_rest_* opacity scale_* rot_*`, with the logarithm of the standard deviation, the
logit of the opacity, the quaternion wxyz, and f_rest channel-major (all red, then green, then blue).
No other module knows logarithms and logits.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from dsar.errors import ExportError
from dsar.types import Gaussians, GaussianSequence
from dsar_exporters.checks import check_sequence, checked_frames
from dsar_exporters.drafts import replacing
from dsar_exporters.optional import require

# A scale of zero or an opacity of one is infinite when encoded, which viewers show as giant splats.
_MIN_SCALE = 1e-8
_OPACITY_MARGIN = 1e-6


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
    if not name or any(separator in name for separator in "/\\"):
        raise ExportError(f"PLY name: expected a name without / or \\, found {name!r}: rename it")
    if sh_degree is not None and sh_degree not in range(4):
        raise ExportError(f"PLY sh_degree: expected 0, 1, 2 or 3, found {sh_degree}")
    check_sequence(sequence)
    plyfile = _require_plyfile()
    paths = []
    for frame, gaussians in checked_frames(sequence):
        vertices = _encode_vertices(_padded(gaussians, sh_degree))
        element = plyfile.PlyElement.describe(vertices, "vertex")
        path = folder / f"{name}.{frame:04d}.ply"
        with replacing(path) as draft:
            plyfile.PlyData([element], byte_order="<", comments=_comments(sequence, frame)).write(draft)
        paths.append(path)
    return paths


def read_ply(path: Path) -> Gaussians:
    """Read a 3D Gaussian Splatting PLY, whoever wrote it, as physical values in the file's own frame.

    Properties are found by name, normals are ignored, and quaternions are normalised.

    Raises:
        ExportError: The file is missing, is no PLY, or lacks a property of a Gaussian.
        MissingDependencyError: plyfile is not installed.
    """
    plyfile = _require_plyfile()
    try:
        vertices = plyfile.PlyData.read(path, mmap=False)["vertex"].data
    except (OSError, KeyError, plyfile.PlyParseError) as error:
        raise ExportError(f"{path}: expected a PLY with an element 'vertex', found {error}") from error
    names = vertices.dtype.names or ()
    rest_names = [f"f_rest_{i}" for i in range(sum(field.startswith("f_rest_") for field in names))]
    count = len(rest_names) // 3 + 1
    if missing := [field for field in _property_names(count) if field not in names and field[0] != "n"]:
        raise ExportError(f"{path}: expected a Gaussian splat PLY, found no properties {', '.join(missing)}")

    def columns(*fields: str) -> Float32[np.ndarray, "n c"]:
        return np.stack([vertices[field] for field in fields], -1).astype(np.float32)

    dc = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    harmonics = dc
    if rest_names:
        rest = columns(*rest_names).reshape(-1, 3, count - 1).transpose(0, 2, 1)
        harmonics = np.concatenate([dc, rest], 1)
    quaternions = torch.from_numpy(columns("rot_0", "rot_1", "rot_2", "rot_3"))
    return Gaussians(
        means=torch.from_numpy(columns("x", "y", "z")),
        rotations=torch.nn.functional.normalize(quaternions, dim=-1),
        scales=torch.from_numpy(columns("scale_0", "scale_1", "scale_2")).exp(),
        opacities=torch.from_numpy(columns("opacity")[:, 0]).sigmoid(),
        harmonics=torch.from_numpy(np.ascontiguousarray(harmonics)),
    )


def _require_plyfile() -> Any:
    return require("plyfile", feature="PLY", package="plyfile", extra="ply")


def _property_names(harmonics_count: int) -> list[str]:
    """Return the property names in file order for 1, 4, 9 or 16 harmonics."""
    groups = {"f_dc": 3, "f_rest": 3 * (harmonics_count - 1)}
    names = ["x", "y", "z", "nx", "ny", "nz"]
    names += [f"{group}_{i}" for group, size in groups.items() for i in range(size)]
    return [*names, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def _padded(gaussians: Gaussians, sh_degree: int | None) -> Gaussians:
    """Return the Gaussians with harmonics extended by zeros, never cut, to a degree."""
    missing = 0 if sh_degree is None else (sh_degree + 1) ** 2 - gaussians.harmonics.shape[1]
    if missing < 0:
        raise ExportError(
            f"PLY sh_degree: expected at least the degree of the sequence, found {sh_degree} for "
            f"{gaussians.harmonics.shape[1]} harmonics: cutting them would change the colours"
        )
    harmonics = torch.nn.functional.pad(gaussians.harmonics, (0, 0, 0, missing))
    return Gaussians(gaussians.means, gaussians.rotations, gaussians.scales, gaussians.opacities, harmonics)


def _encode_vertices(gaussians: Gaussians) -> np.ndarray:
    """Return the records of the element `vertex`, log-scales and logits included."""
    count = gaussians.harmonics.shape[1]
    opacity = gaussians.opacities.clamp(_OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    columns = [
        gaussians.means,
        torch.zeros_like(gaussians.means),
        gaussians.harmonics[:, 0],
        gaussians.harmonics[:, 1:].transpose(1, 2).reshape(len(gaussians), 3 * (count - 1)),
        opacity.logit()[:, None],
        gaussians.scales.clamp_min(_MIN_SCALE).log(),
        gaussians.rotations,
    ]
    rows = torch.cat(columns, 1).numpy().astype("<f4", copy=False)
    dtype = np.dtype([(field, "<f4") for field in _property_names(count)])
    return rows.reshape(-1).view(dtype)


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
    known = ["SplatRenderMode: default", "Vertical axis: 0 1 0"]
    lines = [" ".join(f"dsar.{key} {value}".split()) for key, value in notes.items()]
    return known + [line.encode("ascii", "backslashreplace").decode() for line in lines]
