"""Text and JSON as people's tools write them: with or without a byte-order mark, in UTF-8 or UTF-16."""

import codecs
import json
from pathlib import Path
from typing import Any


def read_text(path: Path, error: type[Exception]) -> str:
    """Return what a text file holds, without its byte-order mark and with line ends as newlines.

    Args:
        path: In UTF-8, or in what its byte-order mark says.
        error: Raised, with a message, where it cannot be read.
    """
    try:
        return decode_text(path.read_bytes())
    except FileNotFoundError as cause:
        raise error(f"{path}: expected a file, found no such file") from cause
    except OSError as cause:
        raise error(f"{path}: cannot be read ({cause.strerror or cause})") from cause
    except UnicodeDecodeError as cause:
        raise error(f"{path}: expected text, found what cannot be read as text ({cause})") from cause


def decode_text(data: bytes) -> str:
    """Return the text in bytes, without its byte-order mark and with line ends as newlines.

    Raises:
        UnicodeDecodeError: it is none in UTF-8, or in what its byte-order mark says.
    """
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = data.decode("utf-16" if wide else "utf-8-sig")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path, error: type[Exception]) -> Any:
    """Return what a JSON file holds.

    Args:
        path: As `read_text` takes it.
        error: Raised, with a message, where it cannot be read.
    """
    text = read_text(path, error)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as cause:
        raise error(f"{path}: expected JSON, found what cannot be read as JSON ({cause})") from cause
