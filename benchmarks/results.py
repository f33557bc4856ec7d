"""The file that a benchmark leaves."""

import json
import os
from pathlib import Path


def write_json(found: dict, path: Path) -> None:
    """Write what was found, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(found, indent=2))
    os.replace(temporary, path)
