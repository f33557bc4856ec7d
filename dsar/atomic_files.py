"""Files that appear whole or not at all, and what is said where the system does not take them."""

import errno
import os
import re
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from shutil import rmtree

from dsar.errors import DsarError, StorageError

_ROOM = "free some room there, or write elsewhere"
_ADVICE = {
    _ROOM: (errno.ENOSPC, errno.EDQUOT, errno.EFBIG),
    "write elsewhere, or change its permissions": (errno.EACCES, errno.EPERM, errno.EROFS),
    "give another path": (errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP),
    "check that it is there": (errno.ENOENT,),
    "its disk or network mount failed: bring it back and run the command again": (
        *(errno.EIO, errno.ESTALE, errno.ENODEV, errno.ENXIO, errno.ENOTCONN, errno.EHOSTDOWN),
        *(errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ETIMEDOUT, errno.EREMOTEIO),
    ),
}
_SHORT = re.compile(r"\d+ requested and \d+ written")
"""NumPy's words for a write that stopped short, which have no code."""
_BUFFER = 16384
"""Bytes that libraries hold back until they close a file, at most."""
_ADVICE_OF_CODE = {code: advice for advice, codes in _ADVICE.items() for code in codes}


def explain_os_error(error: OSError) -> str:
    """Return in words what the system said, and what a person can do about it."""
    if error.errno is None and _SHORT.search(str(error)):
        return f"the disk did not take all of it: {_ROOM}"
    reason = os.strerror(error.errno) if error.errno else str(error)
    advice = _ADVICE_OF_CODE.get(error.errno or 0)
    return f"{reason}: {advice}" if advice else reason


@contextmanager
def naming_storage_errors(path: Path) -> Iterator[None]:
    """Name `path` in what the system says while it is written.

    Libraries that have exceptions of their own quote the system's words, by which they are known.

    Raises:
        StorageError: it cannot be written.
    """
    try:
        yield
    except DsarError:
        raise
    except Exception as error:
        said = error if isinstance(error, OSError) else find_quoted_os_error(str(error))
        if said is None or not _concerns(said, path):
            raise
        raise StorageError(f"{path}: cannot be written: {explain_os_error(said)}") from error


def find_quoted_os_error(text: str) -> OSError | None:
    """Return the system's error whose words a library or another program quotes."""
    codes = (code for code in _ADVICE_OF_CODE if os.strerror(code).lower() in text.lower())
    return next((OSError(code, os.strerror(code)) for code in codes), None)


def _concerns(error: OSError, path: Path) -> bool:
    """Return whether an error is about a file that is being written: what is read has its own name."""
    if not isinstance(error.filename, str | os.PathLike):
        return not isinstance(error, BrokenPipeError)
    path, other = path.absolute(), Path(os.path.abspath(error.filename))
    if not other.is_relative_to(path.parent):
        return other in path.parents
    # Drafts are called after what they become.
    first = other.relative_to(path.parent).parts[:1]
    return not first or first[0].lstrip(".").startswith(path.name)


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`, which takes its place on success.

    Missing folders are made. On any exception the draft is deleted and a file already at `path` keeps its
    contents. The draft has no suffix, so that a pattern such as `*.exr` never meets it. What processes of
    this machine that were killed have left in the folder is swept away.

    Raises:
        StorageError: the system does not take it.
    """
    with naming_storage_errors(path), draft_folder(path) as folder:
        draft = folder / "draft"
        yield draft
        _check_end(draft)
        os.replace(draft, path)


@contextmanager
def draft_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path` for what takes its place, and delete what is left in it.

    Missing folders are made. What killed processes of this machine have left in the folder is swept away.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep(path.parent.absolute(), os.getpid())
    prefix = f".{path.name}.{socket.gethostname()}-{os.getpid()}-"
    with tempfile.TemporaryDirectory(prefix=prefix, dir=path.parent) as folder:
        yield Path(folder)


def replace_together(drafts: dict[Path, Path], folder: Path) -> None:
    """Rename finished files or folders to their targets, the last one last; all of them or none.

    What stands at a target is first moved into `folder`, the last target's first: there is never a last one
    among old and new files. If one cannot be renamed, all that was replaced comes back.

    Args:
        drafts: Targets by draft, in the same file system.
        folder: Takes what is replaced; see `draft_folder`.

    Raises:
        OSError: The system does not take it.
    """
    replaced: dict[Path, Path] = {}
    try:
        for index, target in enumerate(reversed(drafts.values())):
            if target.exists():
                replaced[target] = folder / f"replaced-{index}"
                os.replace(target, replaced[target])
        for draft, target in drafts.items():
            os.replace(draft, target)
    except OSError:
        for target, old in replaced.items():
            if old.exists():
                rmtree(target) if target.is_dir() else target.unlink(missing_ok=True)
                os.replace(old, target)
        raise


def _check_end(draft: Path) -> None:
    """Raise OSError where a disk takes nothing behind a file: then the file may lack its end.

    Libraries in C write the last few kilobytes when they close a file, and seldom look how that went.
    """
    with draft.open("ab", buffering=0) as file:
        end = file.tell()
        try:
            taken = file.write(bytes(_BUFFER))
        finally:
            file.truncate(end)
    if taken < _BUFFER:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def write_text_atomically(path: Path, text: str) -> None:
    """Write a text file, UTF-8, whole or not at all; its folder is made if missing.

    Raises:
        StorageError: the system does not take it.
    """
    with atomic_write(path) as draft:
        draft.write_text(text, encoding="utf-8")


def check_file_writable(path: Path) -> None:
    """Check, before any work, that a file can be put at `path`.

    Raises:
        StorageError: a folder is there, or its own folder cannot be made or written to.
    """
    with naming_storage_errors(path):
        if path.is_dir():
            raise StorageError(f"{path}: expected the name of a file to write, found a folder: {_OTHER}")
    _check_parent(path, path.absolute().parent)


def check_folder_writable(path: Path) -> None:
    """Check, before any work, that files can be put into a folder, which is made if missing.

    Raises:
        StorageError: a file is there, or the folder cannot be made or written to.
    """
    _check_parent(path, path.absolute())


_OTHER = "give another path"


def _check_parent(path: Path, folder: Path) -> None:
    """Check that a folder takes files, or the nearest one above it that is there."""
    with naming_storage_errors(path):
        there = next(each for each in (folder, *folder.parents) if os.path.lexists(each))
        if not there.is_dir():
            what = "a file" if there.exists() else "a link that leads nowhere"
            raise StorageError(f"{path}: expected {there} to be a folder, found {what}: {_OTHER}")
        try:
            tempfile.TemporaryFile(dir=there).close()
        except OSError as error:
            # It speaks of a file whose name nobody gave.
            raise StorageError(f"{path}: cannot be written: {explain_os_error(error)}") from error


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
