"""Whether an EXR file reaches to its end.

OpenEXR does not notice when the disk takes all but the last few kilobytes, which it writes as it closes the
file. Decoding the file again would tell, and cost a third of the time of writing it; its table of chunks
tells at once (https://openexr.com/en/latest/OpenEXRFileLayout.html).
"""

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

_MULTIPART = 0x1000
_LINES_OF_CHUNK = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)
"""By compression: none, rle, zips, zip, piz, pxr24, b44, b44a, dwaa, dwab."""
_DEEP = b"deepscanline"


def is_complete(path: Path) -> bool:
    """Return whether a file that was just written ends where its last chunk does.

    Args:
        path: Of scanlines, deep ones too; of one part or several.
    """
    with path.open("rb") as file:
        try:
            return _expected_size(file) == path.stat().st_size
        except (struct.error, KeyError):
            return False


def _expected_size(file: BinaryIO) -> int:
    """Return the size that a file should have, by its chunk that lies last."""
    _, version = _unpack(file, "<2i")
    multipart = bool(version & _MULTIPART)
    headers = [_read_header(file)]
    while multipart and headers[-1]:
        headers.append(_read_header(file))
    counts = [_chunk_count(header) for header in headers if header]
    offset, part = max(
        (offset, part) for part, count in enumerate(counts) for offset in _unpack(file, f"<{count}Q")
    )
    file.seek(offset + 4 * multipart + 4)
    if headers[part].get("type") == _DEEP:
        return sum(_unpack(file, "<3Q")[:2]) + file.tell()
    return _unpack(file, "<i")[0] + file.tell()


def _read_header(file: BinaryIO) -> dict[str, bytes]:
    """Return the attributes of a part; none behind the last part."""
    attributes = {}
    while name := _read_text(file):
        _read_text(file)
        attributes[name] = file.read(_unpack(file, "<i")[0])
    return attributes


def _chunk_count(header: Mapping[str, bytes]) -> int:
    """Return into how many chunks a part's rows are packed."""
    if "chunkCount" in header:
        return struct.unpack("<i", header["chunkCount"])[0]
    _, first, _, last = struct.unpack("<4i", header["dataWindow"])
    return -(-(last - first + 1) // _LINES_OF_CHUNK[header["compression"][0]])


def _read_text(file: BinaryIO) -> str:
    """Return what stands before the next null."""
    text = bytearray()
    while (byte := file.read(1)) not in (b"\0", b""):
        text += byte
    if not byte:
        raise struct.error("the file ends within its header")
    return text.decode("latin1")


def _unpack(file: BinaryIO, struct_format: str) -> tuple[int, ...]:
    return struct.unpack(struct_format, file.read(struct.calcsize(struct_format)))
