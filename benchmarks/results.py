"""The file that a benchmark leaves."""

import json
from pathlib import Path

from dsar.atomic_files import write_text_atomically


def write_json(found: dict, path: Path) -> None:
    """Write what was found, whole or not at all."""
    write_text_atomically(path, json.dumps(found, indent=2))
