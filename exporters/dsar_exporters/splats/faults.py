"""What is wrong with the values that a splat file holds, before they are decoded.

Decoding hides faults: an infinite logit is an opacity of 1, a length taken for a logarithm a metre.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from dsar.errors import ExportError
from dsar.geometry.harmonics import C0
from dsar_exporters.optional import require
from dsar_exporters.splats.compressed import CHUNK, chunk_faults
from dsar_exporters.splats.encoding import Encoded
from dsar_exporters.splats.reading import (
    describe_foreign,
    encoded_ply,
    is_spz,
    read_file,
    read_spz,
    read_start,
)

_GLB = b"glTF"
_SHORTEST = 1e-12
"""Length of a quaternion that can no longer be normalised."""
_SIGMAS = 6.0
"""Standard deviations that a Gaussian is wide."""
_FEW = 4
"""Gaussians that make a cloud: of fewer, any may hold the others."""
_SPACINGS = 2.0
"""Distances between neighbours that standard deviations, nearly all alike, do not exceed."""
_MAX_SAMPLED = 64
"""Gaussians whose nearest neighbour is looked for."""
_OPACITY_SPREAD, _OPACITY_COUNT = 0.5, 16
"""How far, and of how many Gaussians, opacities go within 0 to 1 when they are no logits by accident."""
_BRIGHTEST, _TYPICAL_DC = 100.0, 10.0
"""Display-referred colour that nothing has, and a constant harmonic that half of a cloud never exceeds."""


def splat_faults(path: Path) -> Iterator[str]:
    """Yield what is wrong with a splat file, in words.

    Args:
        path: A plain or compressed PLY or an SPZ file.

    Raises:
        ExportError: It is none of them, is broken, or holds no Gaussians in 3DGS's encoding.
        MissingDependencyError: Its format's library is not installed.
    """
    if is_spz(path):
        yield from encoded_faults(read_spz(path))
        return
    file = read_file(path)
    encoded = encoded_ply(file.elements, str(path))
    if file.surplus:
        yield (
            f"expected the file to end after the {len(encoded.means)} Gaussians of its header, found "
            f"{file.surplus} bytes more"
        )
    bounds = list(chunk_faults(file.elements[CHUNK])) if CHUNK in file.elements else []
    yield from bounds or encoded_faults(encoded)


def glb_faults(path: Path) -> Iterator[str]:
    """Yield what is wrong with the values of a GLB with KHR_gaussian_splatting, in words.

    Raises:
        ExportError: It is none, or fourdgs finds it broken or outside the extension's rules.
        MissingDependencyError: fourdgs is not installed.
    """
    fourdgs = require("fourdgs", feature="GLB", package="fourdgs", extra="ply")
    expected = f"{path}: expected a GLB with KHR_gaussian_splatting, found"
    if (start := read_start(path, 4)) != _GLB:
        raise ExportError(f"{expected} {describe_foreign(start)}")
    try:
        scene = fourdgs.from_gltf(str(path)).gaussians
    except fourdgs.FourdgsError as error:
        raise ExportError(f"{expected} a faulty one: {str(error).removeprefix('glTF: ')}") from error
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise ExportError(f"{expected} a malformed document: {error}") from error
    if not len(scene.positions):
        yield "expected Gaussians, found none"
        return
    colors = {"the constant harmonics": scene.colors[:, :3], "OPACITY": scene.colors[:, 3]}
    named = {"POSITION": scene.positions, "ROTATION": scene.rotations, "SCALE": scene.scales, **colors}
    for name, values in named.items():
        yield from _finite_faults(name, values)
    with np.errstate(divide="ignore", invalid="ignore"):
        yield from _size_faults(scene.positions, np.log(scene.scales))


def encoded_faults(encoded: Encoded) -> Iterator[str]:
    """Yield what is wrong with encoded values, by the names of their properties in a PLY."""
    count = len(encoded.means)
    if not count:
        yield "expected Gaussians, found none"
        return
    for name, values in _properties(encoded).items():
        yield from _finite_faults(name, values)
    lengths = np.linalg.norm(encoded.rotations.astype(np.float64), axis=1)
    if zeros := int((lengths < _SHORTEST).sum()):
        yield f"expected quaternions in rot_*, found {zeros} of {count} of length 0"
    yield from _opacity_faults(encoded.logits)
    yield from _color_faults(encoded.harmonics[:, 0])
    yield from _size_faults(encoded.means, encoded.log_scales)


def _properties(encoded: Encoded) -> dict[str, Float32[np.ndarray, "..."]]:
    columns = {"f_rest_*": encoded.harmonics[:, 1:], "opacity": encoded.logits}
    for group, values in (
        (("x", "y", "z"), encoded.means),
        (("f_dc_0", "f_dc_1", "f_dc_2"), encoded.harmonics[:, 0]),
        (("scale_0", "scale_1", "scale_2"), encoded.log_scales),
        (("rot_0", "rot_1", "rot_2", "rot_3"), encoded.rotations),
    ):
        columns |= {name: values[:, i] for i, name in enumerate(group)}
    return columns


def _finite_faults(name: str, values: Float32[np.ndarray, "..."]) -> Iterator[str]:
    kinds = {"NaN": np.isnan(values), "inf": np.isposinf(values), "-inf": np.isneginf(values)}
    counts = [f"{int(where.sum())} {kind}" for kind, where in kinds.items() if where.any()]
    if counts:
        yield f"expected finite {name}, found {', '.join(counts)} among {values.size} values"


def _opacity_faults(logits: Float32[np.ndarray, " n"]) -> Iterator[str]:
    least, most = float(logits.min()), float(logits.max())
    if 0 <= least and most <= 1 and most - least > _OPACITY_SPREAD and len(logits) >= _OPACITY_COUNT:
        yield (
            f"expected logits in opacity, found {len(logits)} values from {least:.3g} to {most:.3g}, as if "
            "they were opacities: nothing would be opaque, nothing transparent"
        )


def _color_faults(constants: Float32[np.ndarray, "n 3"]) -> Iterator[str]:
    values = np.abs(constants[np.isfinite(constants)].astype(np.float64))
    if not len(values):
        return
    typical = float(np.median(values))
    if bright := int((0.5 + C0 * values > _BRIGHTEST).sum()):
        yield (
            f"expected colours near 0 to 1 from f_dc_*, found {bright} of {len(values)} beyond "
            f"{_BRIGHTEST:g}, up to {0.5 + C0 * values.max():.3g}"
        )
    elif typical > _TYPICAL_DC:
        yield (
            f"expected harmonics in f_dc_*, found a typical value of {typical:.3g}, a colour of "
            f"{0.5 + C0 * typical:.3g}: are they bytes?"
        )


def _size_faults(means: Float32[np.ndarray, "n 3"], log_scales: Float32[np.ndarray, "n 3"]) -> Iterator[str]:
    """Yield where sizes do not fit their cloud, which has no unit that we could know."""
    usable = np.isfinite(means).all(1) & np.isfinite(log_scales).all(1)
    centers, logarithms = means[usable].astype(np.float64), log_scales[usable].astype(np.float64)
    if len(centers) < _FEW:
        return
    with np.errstate(over="ignore"):
        sizes = np.exp(logarithms.max(1))
    if _are_lengths(centers, logarithms, float(np.median(sizes))):
        yield (
            f"expected logarithms in scale_*, found {logarithms.min():.3g} to {logarithms.max():.3g}, which "
            f"look like metres, not logarithms: all {len(centers)} standard deviations would be above 1"
        )
        return
    # Where all centres are one, the cloud is as wide as its lesser Gaussians.
    cloud = float(np.linalg.norm(np.ptp(centers, axis=0))) or _SIGMAS * float(np.quantile(sizes, 0.25))
    giants = logarithms[sizes > cloud]
    if len(giants):
        lengths = 0 < giants.min() and giants.max() < 1
        yield (
            f"expected Gaussians smaller than their cloud of {cloud:.3g}, found {len(giants)} of "
            f"{len(centers)} with standard deviations up to {sizes.max():.3g}"
            + (": their scale_* look like metres, not logarithms" if lengths else "")
        )


def _are_lengths(
    centers: Float64[np.ndarray, "n 3"], logarithms: Float64[np.ndarray, "n 3"], typical_size: float
) -> bool:
    """Return whether alleged logarithms are lengths.

    Lengths are above 0 and mostly below 1. As logarithms they make Gaussians of 1 to 2.7 units, nearly round
    and nearly alike; that is a cloud in another unit, unless they also swallow their neighbours.
    """
    if not (logarithms.min() > 0 and np.median(logarithms) < 1):
        return False
    sampled = np.linspace(0, len(centers) - 1, min(_MAX_SAMPLED, len(centers))).astype(np.int64)
    nearest = [np.partition(np.linalg.norm(centers - centers[index], axis=1), 1)[1] for index in sampled]
    return typical_size > _SPACINGS * float(np.median(nearest))
