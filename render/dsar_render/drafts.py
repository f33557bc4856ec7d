"""Files that appear whole or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`, which takes its place on success.

    Missing folders are made. On any exception the draft is deleted and a file already at `path` keeps its
    contents. The draft has no suffix, so that a pattern such as `*.exr` never meets it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        draft = Path(folder) / "draft"
        yield draft
        os.replace(draft, path)
