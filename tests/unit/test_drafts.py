import subprocess
import sys

import pytest

from dsar.drafts import replacing


def test_a_finished_draft_replaces_the_file_and_makes_its_folder(tmp_path):
    path = tmp_path / "new" / "image.exr"
    for contents in ("first", "second"):
        with replacing(path) as draft:
            draft.write_text(contents)
            assert not list(tmp_path.rglob("*.exr")) or path.read_text() == "first"
        assert path.read_text() == contents
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_interrupted_draft_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "image.exr"
    path.write_text("old")

    def write_half():
        with replacing(path) as draft:
            draft.write_text("half")
            raise error

    with pytest.raises(error):
        write_half()
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_text() == "old"


_KILLED = """
import os, signal, sys
from pathlib import Path
from dsar.drafts import replacing
with replacing(Path(sys.argv[1])) as draft:
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
    with replacing(tmp_path / "image.1003.exr") as draft:
        draft.write_text("whole")
        assert len(list(tmp_path.iterdir())) == 2
    assert sorted(tmp_path.iterdir()) == [elsewhere, tmp_path / "image.1003.exr"]
