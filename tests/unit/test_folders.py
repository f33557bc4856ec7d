"""Folders and text as people have them: litter, suffixes, byte-order marks, names that lead elsewhere."""

import unicodedata
import zipfile

import pytest

from dsar.data.folders import Finder, check_name, find_file, inside, list_folder, list_images, list_members
from dsar.errors import CaptureError, ConfigError
from dsar.text import read_json, read_text

LITTER = (
    "._a.png",
    ".DS_Store",
    "Thumbs.db",
    "desktop.ini",
    "__MACOSX/._a.png",
    "@eaDir/a.png",
    ".hidden/a.png",
)


def touch(root, *names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"")


def test_litter_is_passed_over_in_folders_and_archives(tmp_path):
    touch(tmp_path, *LITTER, "b.png", "a.JPG", "notes.txt", "sub folder/c.png")
    assert [path.name for path in list_folder(tmp_path)] == ["a.JPG", "b.png", "notes.txt", "sub folder"]
    assert [path.name for path in list_images(tmp_path)] == ["a.JPG", "b.png"]
    assert list_folder(tmp_path / "none") == []
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for name in (*LITTER, "top/", "top/._b.png", "top/b.png"):
            archive.writestr(name, b"")
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert list_members(archive) == ["top/b.png"]


def test_files_are_found_whatever_the_case_of_their_names_and_the_kind_of_image(tmp_path):
    decomposed = unicodedata.normalize("NFD", "Körper")
    touch(tmp_path, "Mask/PHA/0001.PNG", "b/1.jpeg", "b/1.json", f"{decomposed}/1.jpg", "c/1.png", "c/1.JPG")
    finder = Finder(tmp_path)
    for asked, found in {
        "mask/pha/0001.jpg": "Mask/PHA/0001.PNG",
        "b/1.jpg": "b/1.jpeg",
        "b/1.JSON": "b/1.json",
        "Körper/1.jpg": f"{decomposed}/1.jpg",
        # Of several, that of the suffix that was asked for.
        "c/1.jpg": "c/1.JPG",
        "c/1.png": "c/1.png",
    }.items():
        assert finder.find(tmp_path / asked) == tmp_path / found
    for absent in ("mask/pha/0002.jpg", "b/1.npz", "b/1", "none/1.jpg", "b/1.jpeg/x"):
        assert finder.find(tmp_path / absent) is None
    assert find_file(tmp_path, "B").name == "b"
    assert find_file(tmp_path, "calibration.json") == tmp_path / "calibration.json"


@pytest.mark.parametrize("name", ["../a", "/etc/passwd", "a/../../b", "C:\\a", "..\\a", "", "\\\\host\\a"])
def test_files_that_a_file_names_lie_in_its_folder(tmp_path, name):
    with pytest.raises(CaptureError, match=r"record: expected a path inside .*, found"):
        inside("record", tmp_path, name)


def test_files_in_the_folder_are_found(tmp_path):
    touch(tmp_path, "Images/Walk.ZIP")
    for name in ("images/walk.zip", "./images\\walk.zip", "images//walk.zip"):
        assert inside("record", tmp_path, name) == tmp_path / "Images/Walk.ZIP"
    assert inside("record", tmp_path, "a..b/c d.npz") == tmp_path / "a..b/c d.npz"


@pytest.mark.parametrize(
    "name", ["", " ", ".", "..", "../a", "a/b", "a\\b", ".a", "a:b", "a\nb", "a\0b", " a", 'a"', "a*"]
)
def test_names_that_no_file_can_have_are_refused(name):
    with pytest.raises(CaptureError, match="at: expected a name that can be a file's, found"):
        check_name("at", name)


def test_names_of_other_letters_and_with_spaces_are_names():
    for name in ("spin_left", "Gehen 2", "歩く", "take-1.b", "Kamera vorne links"):
        assert check_name("at", name) == name


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_is_read_with_and_without_a_mark_of_its_encoding(tmp_path, encoding):
    path = tmp_path / "a.json"
    path.write_bytes('{"Größe":\r\n [1,\r2]}\n'.encode(encoding))
    assert read_text(path, CaptureError) == '{"Größe":\n [1,\n2]}\n'
    assert read_json(path, CaptureError) == {"Größe": [1, 2]}


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"\xff\x00\x81", "expected text, found what cannot be read as text"),
        (b"{", "expected JSON, found what cannot be read as JSON"),
        (b"[" * 100_000, "expected JSON, found what cannot be read as JSON"),
        (None, "expected a file, found no such file"),
    ],
)
def test_unreadable_text_is_refused_as_the_error_that_was_asked_for(tmp_path, content, fault):
    if content is not None:
        (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(ConfigError, match=rf"a\.json: {fault}"):
        read_json(tmp_path / "a.json", ConfigError)
