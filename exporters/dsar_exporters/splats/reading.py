"""Splat files of any kind, whoever wrote them, as encoded or physical values.

What a file is its first bytes and its elements say, never its name.
"""

import gzip
import io
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from dsar.errors import ExportError
from dsar.types import Gaussians
from dsar_exporters.optional import require
from dsar_exporters.splats.compressed import CHUNK, VERTEX, unpack
from dsar_exporters.splats.encoding import Encoded, decode
from dsar_exporters.splats.ply import property_names, require_plyfile

_PLY, _GZIP, _NGSP, _APPLE = b"ply", b"\x1f\x8b", b"NGSP", b"\x00\x05\x16\x07"
_HEADER_END = b"end_header"
_HEADER_BYTES = 1 << 20
_REST_COUNTS = (0, 9, 24, 45)
"""Harmonics above the constant, three channels each, of degrees 0 to 3."""
_SPZ_VERSIONS = (2, 3, 4)
"""Version 1 holds positions of 16 bits, which nobody writes any more."""
_ZSTD_VERSION = 4


@dataclass(frozen=True)
class PlyFile:
    """What a PLY holds."""

    elements: Mapping[str, np.ndarray]
    """Records by the name of their element."""
    surplus: int
    """Bytes after the last record that the header counts."""


def read_splats(path: Path) -> Gaussians:
    """Read a 3DGS PLY, a compressed PLY or an SPZ file, as physical values in the file's own frame.

    Properties are found by name, normals are ignored, and quaternions are normalised.

    Raises:
        ExportError: The file is missing, is none of them, is cut short or lacks a property of a Gaussian.
        MissingDependencyError: plyfile, gsply or, for SPZ version 4, zstandard is not installed.
    """
    return decode(read_spz(path) if is_spz(path) else encoded_ply(read_file(path).elements, str(path)))


def read_ply(path: Path) -> Gaussians:
    """Read a PLY, plain or compressed; see `read_splats`."""
    return decode(encoded_ply(read_file(path).elements, str(path)))


def is_spz(path: Path) -> bool:
    """Return whether a file is to be read as SPZ: by its first bytes, by its suffix if these say nothing."""
    start = read_start(path, 4) if path.is_file() else b""
    return start.startswith((_GZIP, _NGSP)) or (path.suffix.lower() == ".spz" and not start.startswith(_PLY))


def read_file(path: Path) -> PlyFile:
    """Read a PLY: text or binary of either byte order, with comments in any alphabet.

    Raises:
        ExportError: It is no PLY or is cut short.
        MissingDependencyError: plyfile is not installed.
    """
    plyfile = require_plyfile()
    data = read_start(path)
    if not data.startswith(_PLY):
        raise ExportError(f"{path}: expected a PLY, found {describe_foreign(data)}")
    end = data[:_HEADER_BYTES].find(_HEADER_END)
    if end < 0:
        raise ExportError(f"{path}: expected a PLY, found no end of its header: it was cut short")
    # plyfile takes no comment but ASCII, and writers put paths and names there.
    header = data[:end].decode("ascii", "replace").encode("ascii", "replace")
    stream = io.BytesIO(header + data[end:])
    try:
        elements = plyfile.PlyData.read(stream, mmap=False).elements
    except MemoryError as error:
        raise ExportError(
            f"{path}: expected a PLY, found a header that counts more than it can hold"
        ) from error
    except (ValueError, plyfile.PlyParseError) as error:
        raise ExportError(
            f"{path}: expected a PLY, found one that is broken or cut short: {error}"
        ) from error
    # plyfile closes what it read as text, where lines tell how much there is.
    surplus = 0 if stream.closed else len(stream.read().strip())
    return PlyFile({element.name: element.data for element in elements}, surplus)


def encoded_ply(elements: Mapping[str, np.ndarray], where: str) -> Encoded:
    """Return the Gaussians of a PLY's records.

    Raises:
        ExportError: They are none, or not encoded as 3DGS does; `where` names the file.
    """
    if CHUNK in elements:
        return unpack(elements, where)
    if VERTEX not in elements:
        raise ExportError(
            f"{where}: expected a PLY with an element 'vertex', found {', '.join(elements) or 'no element'}"
        )
    vertices = elements[VERTEX]
    names = vertices.dtype.names or ()
    rest_names = [f"f_rest_{i}" for i in range(sum(field.startswith("f_rest_") for field in names))]
    if len(rest_names) not in _REST_COUNTS:
        raise ExportError(f"{where}: expected 0, 9, 24 or 45 properties f_rest_*, found {len(rest_names)}")
    count = len(rest_names) // 3 + 1
    required = [field for field in property_names(count) if field[0] != "n"]
    if missing := [field for field in required if field not in names]:
        raise ExportError(
            f"{where}: expected a Gaussian splat PLY, found {_kind(elements)} no properties "
            f"{', '.join(missing)}"
        )
    for field in required:
        if vertices.dtype[field].kind != "f":
            raise ExportError(
                f"{where}: expected a float or double in {field}, found {_type(vertices.dtype[field])}: what "
                "its steps mean the file does not say"
            )

    def columns(*fields: str) -> Float32[np.ndarray, "n c"]:
        with np.errstate(over="ignore"):  # doubles beyond float32 become infinite, which is told
            return np.stack([vertices[field] for field in fields], -1).astype(np.float32)

    harmonics = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest_names:
        rest = columns(*rest_names).reshape(-1, 3, count - 1).transpose(0, 2, 1)
        harmonics = np.ascontiguousarray(np.concatenate([harmonics, rest], 1))
    return Encoded(
        means=columns("x", "y", "z"),
        log_scales=columns("scale_0", "scale_1", "scale_2"),
        rotations=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        logits=columns("opacity")[:, 0],
        harmonics=harmonics,
    )


def _kind(elements: Mapping[str, np.ndarray]) -> str:
    """Return what a PLY is that holds no Gaussians, as the start of a list of what it lacks."""
    names = elements[VERTEX].dtype.names or ()
    if "packed_position" in names:
        return "a compressed PLY without its element 'chunk', so"
    if "scale_1" in names and "scale_2" not in names:
        return "2D Gaussians (flat discs with two scales, as 2DGS writes), which have"
    if len(elements.get("face", ())):
        return "a mesh, which has"
    if "x" in names and "opacity" not in names and "scale_0" not in names:
        return "a point cloud, which has"
    return "a file with"


def _type(dtype: np.dtype) -> str:
    return "lists" if dtype.kind == "O" else dtype.name


def read_spz(path: Path) -> Encoded:
    """Read an SPZ file; see `read_splats`."""
    gsply = require("gsply", feature="SPZ", package="gsply", extra="ply")
    version = _spz_version(path)
    if version not in _SPZ_VERSIONS:
        raise ExportError(
            f"{path}: expected SPZ of version 2, 3 or 4, found version {version}: write it as version 3"
        )
    broken: tuple[type[Exception], ...] = (ValueError, IndexError, struct.error, MemoryError)
    if version == _ZSTD_VERSION:
        zstandard = require("zstandard", feature="SPZ version 4", package="zstandard", extra="ply")
        broken += (zstandard.ZstdError,)
    try:
        data = gsply.read_spz(path)
    except broken as error:
        reason = error.__cause__ or error
        raise ExportError(f"{path}: expected an SPZ file, found one that is broken: {reason}") from error
    dc = data.sh0[:, None]
    harmonics = dc if data.shN is None else np.concatenate([dc, data.shN.reshape(len(dc), -1, 3)], 1)
    arrays = {
        "means": data.means,
        "log_scales": data.scales,
        "rotations": data.quats,
        "logits": data.opacities,
        "harmonics": harmonics,
    }
    return Encoded(**{name: np.array(values, np.float32) for name, values in arrays.items()})


def _spz_version(path: Path) -> int:
    """Return the version in an SPZ's header, which is compressed up to version 3."""
    head = read_start(path, 8)
    if head.startswith(_GZIP):
        try:
            with gzip.open(path) as file:
                head = file.read(8)
        except (gzip.BadGzipFile, EOFError, zlib.error) as error:
            raise ExportError(f"{path}: expected an SPZ file, found gzip that is broken: {error}") from error
    if len(head) < 8 or not head.startswith(_NGSP):
        raise ExportError(f"{path}: expected an SPZ file, found {describe_foreign(head)}")
    return struct.unpack_from("<I", head, 4)[0]


def describe_foreign(start: bytes) -> str:
    """Return what a file is that is none of ours."""
    if start.startswith(_APPLE):
        return "what macOS notes about the file of this name without ._"
    return f"one that starts with {start[:4]!r}" if start else "an empty file"


def read_start(path: Path, count: int = -1) -> bytes:
    """Return a file's first bytes, all by default.

    Raises:
        ExportError: There is none.
    """
    if not path.is_file():
        raise ExportError(f"{path}: expected a PLY or an SPZ file, found none: give its path")
    with path.open("rb") as file:
        return file.read(count)
