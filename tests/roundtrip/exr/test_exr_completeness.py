"""Which files are there already, whole and of this very job."""

import dataclasses
import os
from pathlib import Path

import pytest
from exr_files import (
    write,
)
from faults import contents, full_disk

from dsar.errors import StorageError
from dsar_exporters import ColorTarget, ExrSequence
from dsar_exporters.exr.completeness import is_complete


@pytest.fixture(params=["zips", "dwaa", "multipart"])
def written(request, picture, side, tmp_path) -> tuple[ExrSequence, list[Path]]:
    """Two views with deep files, and a third's folder of which nothing is asked."""
    how = {"views": "multipart"} if request.param == "multipart" else {"compression": request.param}
    sequence = ExrSequence(tmp_path, layers=("rgba", "Z", "id"), **how)
    return sequence, sequence.write([picture, side], ["job a", "job b"])


def complete(
    sequence: ExrSequence, *, frame=1003, cameras=("front", "side"), jobs=("job a", "job b"), deep=True
):
    return sequence.is_complete(frame, cameras, jobs, deep)


def test_what_was_written_is_complete(written):
    sequence, _ = written
    assert complete(sequence)
    assert complete(sequence, deep=False)
    assert complete(sequence, cameras=("side", "front"), jobs=("job b", "job a"))


def test_files_of_other_jobs_frames_and_cameras_do_not_count(written):
    sequence, _ = written
    assert not complete(sequence, jobs=("job a", "job c"))
    assert not complete(sequence, jobs=("job b", "job a"))
    assert not complete(sequence, jobs=("job a", ""))
    assert not complete(sequence, frame=1004)
    assert not complete(sequence, cameras=("front", "back"))
    assert not complete(dataclasses.replace(sequence, name="other"))
    assert not complete(dataclasses.replace(sequence, folder=sequence.folder / "other"))


def test_a_file_with_other_cameras_beside_those_wanted_is_not_theirs(picture, side, tmp_path):
    sequence = ExrSequence(tmp_path, layers=("rgba",), views="multipart")
    sequence.write([picture, side], ["job a", "job b"])
    assert complete(sequence, deep=False)
    assert not complete(sequence, cameras=("side",), jobs=("job b",), deep=False)
    assert not complete(sequence, cameras=("front",), jobs=("job a",), deep=False)


def test_a_missing_file_is_noticed(written):
    sequence, paths = written
    for path in paths:
        content = path.read_bytes()
        path.unlink()
        assert not complete(sequence)
        assert complete(sequence, deep=False) == ("_deep" in path.name)
        path.write_bytes(content)
    assert complete(sequence)


def test_a_file_that_is_cut_off_anywhere_is_noticed(written, capfd):
    sequence, paths = written
    for path in paths:
        content = path.read_bytes()
        size = len(content)
        for length in (0, 1, 4, 300, size // 10, size // 3, size // 2, 9 * size // 10, size - 40, size - 1):
            path.write_bytes(content[:length])
            assert not complete(sequence), (path.name, length, size)
        path.write_bytes(content)
    assert complete(sequence)
    # OpenEXR says on its own channels what it found.
    capfd.readouterr()


def test_the_end_of_a_file_is_found_wherever_it_is_cut(written):
    for path in written[1]:
        content = path.read_bytes()
        assert is_complete(path)
        for missing in (*range(1, 30), *range(30, len(content), len(content) // 70)):
            os.truncate(path, len(content) - missing)
            assert not is_complete(path), (path.name, missing)
        path.write_bytes(content + b"0")
        assert not is_complete(path)


@pytest.mark.parametrize("missing", [1, 10, 700, 3000, 5000])
def test_a_disk_that_takes_all_but_the_end_leaves_the_earlier_file(picture, tmp_path, missing):
    """OpenEXR writes the last kilobytes when it closes a file, and does not look whether that went well."""
    sequence = ExrSequence(tmp_path, layers=("rgba",))
    (path, _) = sequence.write([picture], ["old"])
    before = contents(tmp_path)
    with full_disk(path.stat().st_size - missing), pytest.raises(StorageError, match="free some room"):
        sequence.write([picture], ["new"])
    assert contents(tmp_path) == before


def test_something_else_in_a_files_place_is_noticed(written):
    sequence, paths = written
    for content in (b"", b"not an image at all", b"\x76\x2f\x31\x01", bytes(5000)):
        paths[0].write_bytes(content)
        assert not complete(sequence)
    paths[0].unlink()
    paths[0].mkdir()
    assert not complete(sequence)


def test_an_image_of_one_camera_in_the_folder_of_another_is_noticed(picture, side, tmp_path):
    sequence = ExrSequence(tmp_path, layers=("rgba",))
    one, two, *_ = sequence.write([picture, side], ["job", "job"])
    assert complete(sequence, jobs=("job", "job"))
    one.write_bytes(two.read_bytes())
    assert not complete(sequence, jobs=("job", "job"))


def test_other_settings_are_other_jobs(tmp_path):
    base = {"folder": tmp_path, "layers": ("rgba", "Z")}
    others = [
        {"name": "other"},
        {"layers": ("rgba",)},
        {"layers": ("Z", "rgba")},
        {"compression": "zip"},
        {"views": "multipart"},
        {"crop": True},
        {"target": ColorTarget("ACEScg")},
    ]
    keys = [ExrSequence(**(base | each)).key for each in ({}, *others)]
    assert len(set(keys)) == len(keys)
    # Where they are written is no matter: a farm's machines mount folders where they like.
    assert ExrSequence(**(base | {"folder": tmp_path / "elsewhere"})).key == keys[0]


@pytest.mark.parametrize(
    "settings",
    [{}, {"compression": "dwaa"}, {"views": "multipart", "crop": True}, {"compression": "piz"}],
    ids=str,
)
def test_the_same_picture_makes_the_same_bytes(picture, side, tmp_path, settings):
    one, two = (write(tmp_path / name, picture, side, **settings) for name in ("one", "two"))
    assert [path.read_bytes() for path in one] == [path.read_bytes() for path in two]
    again = write(tmp_path / "one", picture, side, **settings)
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in two]
