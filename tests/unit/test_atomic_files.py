import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from faults import full_disk, read_only

from dsar.atomic_files import (
    atomic_write,
    check_file_writable,
    check_folder_writable,
    find_quoted_os_error,
    naming_storage_errors,
    write_text_atomically,
)
from dsar.errors import CaptureError, StorageError


def test_a_finished_draft_replaces_the_file_and_makes_its_folder(tmp_path):
    path = tmp_path / "new" / "image.exr"
    for contents in ("first", "second"):
        with atomic_write(path) as draft:
            draft.write_text(contents)
            assert not list(tmp_path.rglob("*.exr")) or path.read_text() == "first"
        assert path.read_text() == contents
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_interrupted_draft_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "image.exr"
    path.write_text("old")

    def write_half():
        with atomic_write(path) as draft:
            draft.write_text("half")
            raise error

    with pytest.raises(error):
        write_half()
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_text() == "old"


_KILLED = """
import os, signal, sys
from pathlib import Path
from dsar.atomic_files import atomic_write
with atomic_write(Path(sys.argv[1])) as draft:
    draft.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_drafts_of_killed_processes_are_swept_and_those_of_others_are_not(tmp_path):
    path = tmp_path / "image.1001.exr"
    subprocess.run([sys.executable, "-c", _KILLED, str(path)], check=False)
    elsewhere = tmp_path / ".image.1002.exr.another_machine-1-abc"
    elsewhere.mkdir()
    (left,) = (each for each in tmp_path.iterdir() if each != elsewhere)
    assert (left / "draft").read_text() == "half"
    with atomic_write(tmp_path / "image.1003.exr") as draft:
        draft.write_text("whole")
        assert len(list(tmp_path.iterdir())) == 2
    assert sorted(tmp_path.iterdir()) == [elsewhere, tmp_path / "image.1003.exr"]


def test_a_full_disk_names_the_file_and_keeps_the_old_one(tmp_path):
    path = tmp_path / "figures.json"
    write_text_atomically(path, "old")
    with full_disk(10), pytest.raises(StorageError, match=r"figures\.json: cannot be written: .*: free some"):
        write_text_atomically(path, "new " * 10)
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_text() == "old"


def test_what_libraries_quote_of_the_system_is_the_systems(tmp_path):
    with pytest.raises(StorageError, match=r"a\.exr: cannot be written: No space left on device: free some"):
        with naming_storage_errors(tmp_path / "a.exr"):
            raise RuntimeError("Failed to write pixel data. No space left on device.")
    with pytest.raises(RuntimeError, match="three channels"), naming_storage_errors(tmp_path / "a.exr"):
        raise RuntimeError("expected three channels")
    assert find_quoted_os_error("i/o error: FILE TOO LARGE (os error 27)").errno == errno.EFBIG
    assert find_quoted_os_error("nothing of the kind") is None


def test_numpys_short_writes_are_a_disk_without_room(tmp_path):
    path = tmp_path / "a.spz"
    with full_disk(5000), pytest.raises(StorageError, match=r"a\.spz: cannot be written: .*: free some room"):
        with atomic_write(path) as draft:
            np.zeros(8000, np.uint8).tofile(draft)
    assert not list(tmp_path.iterdir())


def test_what_is_read_while_a_file_is_written_has_its_own_name(tmp_path):
    """A video takes its images as it goes: one that is missing is not the video's fault."""
    for elsewhere in (tmp_path / "images" / "0001.png", Path("/nowhere/at/all.png")):
        with pytest.raises(FileNotFoundError) as caught, atomic_write(tmp_path / "video.mp4"):
            elsewhere.read_bytes()
        assert caught.value.filename == str(elsewhere)
    with pytest.raises(CaptureError, match="No such file or directory"), atomic_write(tmp_path / "video.mp4"):
        raise CaptureError("image 0001.png: No such file or directory")


def test_errors_about_drafts_and_folders_above_are_the_files_own(tmp_path):
    path = tmp_path / "deep" / "a.exr"
    for named in (path, tmp_path / "deep" / ".a.exr.host-1-x" / "draft", tmp_path / "deep", tmp_path):
        with pytest.raises(StorageError, match=r"a\.exr: cannot be written: Stale file handle: .*mount"):
            with naming_storage_errors(path):
                raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(named))


def test_places_are_checked_without_leaving_a_trace(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "lost").symlink_to(tmp_path / "nowhere")
    check_file_writable(tmp_path / "new" / "a.usda")
    check_file_writable(tmp_path / "file")
    check_folder_writable(tmp_path / "new" / "exr")
    check_folder_writable(tmp_path)
    for check, path, message in (
        (check_file_writable, tmp_path, "expected the name of a file to write, found a folder"),
        (check_file_writable, tmp_path / "file" / "a.usda", "to be a folder, found a file"),
        (check_folder_writable, tmp_path / "file", "to be a folder, found a file"),
        (check_folder_writable, tmp_path / "file" / "exr", "to be a folder, found a file"),
        (check_folder_writable, tmp_path / "lost" / "exr", "found a link that leads nowhere"),
        (check_file_writable, tmp_path / ("a" * 300) / "b", "File name too long: give another path"),
    ):
        with pytest.raises(StorageError, match=message) as caught:
            check(path)
        assert str(caught.value).startswith(f"{path}: ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "lost"]
    with read_only(tmp_path):
        for check in (check_file_writable, check_folder_writable):
            with pytest.raises(StorageError, match="Permission denied: write elsewhere"):
                check(tmp_path / "new" / "a")
