"""PlayCanvas's compressed PLY, unpacked: integers within the bounds of chunks of 256 Gaussians.

An element `chunk` holds the least and greatest position, log-scale and, in its newer layout of 18
properties, colour of 256 Gaussians; the older of 12 leaves colours within 0 to 1. `vertex` packs a Gaussian
into four 32-bit integers, from the highest bit: position and scale of 11, 10 and 11 bits, the quaternion's
largest part's index in 2 and the others in 10 each, colour and opacity of 8 each. `sh`, if there is one, has
a byte a coefficient from -4 to 4, channel-major.
"""

from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Float32, Float64, UInt32

from dsar.errors import ExportError
from dsar.geometry.harmonics import C0
from dsar_exporters.splats.encoding import Encoded

CHUNK, VERTEX, HARMONICS = "chunk", "vertex", "sh"
"""Elements of such a file."""
_SIZE = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = {
    "position": (("min_x", "min_y", "min_z"), ("max_x", "max_y", "max_z")),
    "scale": (("min_scale_x", "min_scale_y", "min_scale_z"), ("max_scale_x", "max_scale_y", "max_scale_z")),
}
_COLOR_BOUNDS = ("min_r", "min_g", "min_b"), ("max_r", "max_g", "max_b")
_MIXED_BITS = ((21, 11), (11, 10), (0, 11))
"""Shift and width of the three numbers of a position or scale."""
_BYTES = ((24, 8), (16, 8), (8, 8), (0, 8))
_QUATERNION_BITS = ((20, 10), (10, 10), (0, 10))
_OPAQUE = 10.0
"""Logit of the bytes 0 and 255, which mean opacities that have none."""


def unpack(elements: Mapping[str, np.ndarray], where: str) -> Encoded:
    """Return the Gaussians of a compressed PLY in the values that a plain one holds.

    Args:
        elements: Records by the name of their element.
        where: How errors call the file.

    Raises:
        ExportError: An element lacks a property, or chunks do not fit the number of Gaussians.
    """
    chunks, packed = elements[CHUNK], elements.get(VERTEX, np.zeros(0))
    names = {CHUNK: chunks.dtype.names or (), VERTEX: packed.dtype.names or ()}
    required = {CHUNK: [name for bounds in _BOUNDS.values() for side in bounds for name in side]}
    required[VERTEX] = list(_PACKED)
    for element, fields in required.items():
        if missing := [field for field in fields if field not in names[element]]:
            raise ExportError(
                f"{where}: expected a compressed PLY, found no properties {', '.join(missing)} in its "
                f"element '{element}'"
            )
    if len(chunks) != -(-len(packed) // _SIZE):
        raise ExportError(
            f"{where}: expected a chunk for each {_SIZE} of its {len(packed)} Gaussians, "
            f"{-(-len(packed) // _SIZE)} chunks, found {len(chunks)}"
        )
    words = {name: packed[name].astype(np.uint32) for name in _PACKED}
    color, opacity = np.split(_fractions(words["packed_color"], _BYTES), [3], 1)
    if _has_color_bounds(chunks):
        color = _denormalize(color, chunks, *_COLOR_BOUNDS)
    with np.errstate(divide="ignore"):
        logits = np.log(opacity) - np.log1p(-opacity)
    dc = ((color - 0.5) / C0)[:, None]
    return Encoded(
        means=_as_float32(
            _denormalize(_fractions(words["packed_position"], _MIXED_BITS), chunks, *_BOUNDS["position"])
        ),
        log_scales=_as_float32(
            _denormalize(_fractions(words["packed_scale"], _MIXED_BITS), chunks, *_BOUNDS["scale"])
        ),
        rotations=_as_float32(_quaternions(words["packed_rotation"])),
        logits=_as_float32(logits.clip(-_OPAQUE, _OPAQUE)[:, 0]),
        harmonics=_as_float32(
            np.concatenate([dc, _unpack_harmonics(elements.get(HARMONICS), len(packed), where)], 1)
        ),
    )


def chunk_faults(chunks: np.ndarray) -> Iterator[str]:
    """Yield what is wrong with the bounds of chunks: from them every value of 256 Gaussians is made."""
    bounds = [*_BOUNDS.values(), *([_COLOR_BOUNDS] if _has_color_bounds(chunks) else [])]
    for low, high in (pair for sides in bounds for pair in zip(*sides, strict=True)):
        lows, highs = chunks[low].astype(np.float64), chunks[high].astype(np.float64)
        finite = np.isfinite(lows) & np.isfinite(highs)
        if not finite.all():
            yield (
                f"expected finite {low} and {high}, found {int((~finite).sum())} of {len(chunks)} chunks "
                "without"
            )
        if inverted := int((lows[finite] > highs[finite]).sum()):
            yield f"expected {low} below {high}, found {inverted} of {len(chunks)} chunks the other way round"


def _has_color_bounds(chunks: np.ndarray) -> bool:
    return all(name in (chunks.dtype.names or ()) for side in _COLOR_BOUNDS for name in side)


def _fractions(
    words: UInt32[np.ndarray, " n"], bits: tuple[tuple[int, int], ...]
) -> Float64[np.ndarray, "n c"]:
    """Return the numbers in words, each as a fraction of its greatest."""
    return np.stack([(words >> shift & ((1 << width) - 1)) / ((1 << width) - 1) for shift, width in bits], 1)


def _denormalize(
    fractions: Float64[np.ndarray, "n 3"], chunks: np.ndarray, low: tuple[str, ...], high: tuple[str, ...]
) -> Float64[np.ndarray, "n 3"]:
    """Return values that are fractions of the way between the bounds of their chunks."""
    chunk_of = np.arange(len(fractions)) // _SIZE
    lows, highs = (
        np.stack([chunks[name].astype(np.float64)[chunk_of] for name in side], 1) for side in (low, high)
    )
    with np.errstate(invalid="ignore"):  # infinite bounds: `chunk_faults` names them
        return lows + fractions * (highs - lows)


def _quaternions(words: UInt32[np.ndarray, " n"]) -> Float64[np.ndarray, "n 4"]:
    """Return quaternions wxyz: of three parts, and the largest that makes their length 1."""
    others = (_fractions(words, _QUATERNION_BITS) - 0.5) * np.sqrt(2)
    largest = np.sqrt(np.maximum(1 - (others**2).sum(1), 0))
    position = (words >> 30)[:, None]
    parts = np.arange(4)
    # Below the largest's position stand the parts of their own number, above it those of one less.
    source = np.clip(parts - (parts > position), 0, 2)
    return np.where(parts == position, largest[:, None], np.take_along_axis(others, source, 1))


def _unpack_harmonics(records: np.ndarray | None, count: int, where: str) -> Float64[np.ndarray, "n k 3"]:
    """Return the harmonics above the constant."""
    if records is None or not records.dtype.names:
        return np.zeros((count, 0, 3))
    names = records.dtype.names
    if len(records) != count or len(names) not in (9, 24, 45):
        raise ExportError(
            f"{where}: expected 9, 24 or 45 harmonics of each of {count} Gaussians in its element "
            f"'{HARMONICS}', found {len(names)} of {len(records)}"
        )
    bytes_ = np.stack([records[name] for name in names], 1).astype(np.float64)
    return ((bytes_ - 127.5) / 32).reshape(count, 3, -1).transpose(0, 2, 1)


def _as_float32(values: np.ndarray) -> Float32[np.ndarray, "..."]:
    return np.ascontiguousarray(values, np.float32)
