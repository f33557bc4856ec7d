"""Files that appear whole or not at all."""

import os
import re
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from shutil import rmtree


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`, which takes its place on success.

    Missing folders are made. On any exception the draft is deleted and a file already at `path` keeps its
    contents. The draft has no suffix, so that a pattern such as `*.exr` never meets it. What processes of
    this machine that were killed have left in the folder is swept away.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep(path.parent.absolute(), os.getpid())
    prefix = f".{path.name}.{socket.gethostname()}-{os.getpid()}-"
    with tempfile.TemporaryDirectory(prefix=prefix, dir=path.parent) as folder:
        draft = Path(folder) / "draft"
        yield draft
        os.replace(draft, path)


@cache
def _sweep(folder: Path, process: int) -> None:
    """Delete the drafts of processes that are no more; once a folder and process."""
    ours = re.compile(rf"\..+\.{re.escape(socket.gethostname())}-(\d+)-\w+")
    for left in folder.iterdir():
        match = ours.fullmatch(left.name)
        if match and not _runs(int(match[1])):
            rmtree(left, ignore_errors=True)


def _runs(process: int) -> bool:
    """Return whether a process of this machine is alive."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # someone else's, and alive
    return True
