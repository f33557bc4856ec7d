"""PNG sequences."""

from pathlib import Path

import numpy as np
from PIL import Image

from dsar.types import Picture
from dsar_render.images import PngSequence


def pngs(folder: Path, *pictures: Picture) -> tuple[PngSequence, list[Path]]:
    sequence = PngSequence(folder, "anna")
    return sequence, sequence.write(pictures, [f"job of {picture.camera.name}" for picture in pictures])


def test_pngs_are_complete_when_they_are_whole_and_of_this_job(picture, side, tmp_path):
    sequence, paths = pngs(tmp_path, picture, side)
    assert [str(path.relative_to(tmp_path)) for path in paths] == [
        "front/anna.front.1003.png",
        "side/anna.side.1003.png",
    ]
    jobs = ["job of front", "job of side"]
    assert sequence.is_complete(1003, ["front", "side"], jobs, False)
    assert sequence.is_complete(1003, ["front", "side"], jobs, True)
    assert not sequence.is_complete(1003, ["front", "side"], jobs[::-1], False)
    assert not sequence.is_complete(1004, ["front"], jobs[:1], False)
    assert not sequence.is_complete(1003, ["back"], jobs[:1], False)
    assert not PngSequence(tmp_path, "other").is_complete(1003, ["front"], jobs[:1], False)
    assert sequence.key != PngSequence(tmp_path, "other").key


def test_a_png_that_is_cut_off_anywhere_is_noticed(picture, tmp_path):
    sequence, (path,) = pngs(tmp_path, picture)
    content = path.read_bytes()
    size = len(content)
    for length in (0, 1, 8, 33, 100, size // 4, size // 2, size - 500, size - 20, size - 12, size - 1):
        path.write_bytes(content[:length])
        assert not sequence.is_complete(1003, ["front"], ["job of front"], False), (length, size)
    path.write_bytes(b"nothing like it")
    assert not sequence.is_complete(1003, ["front"], ["job of front"], False)
    path.write_bytes(content)
    assert sequence.is_complete(1003, ["front"], ["job of front"], False)


def test_the_same_picture_makes_the_same_png(picture, tmp_path):
    one, two = (pngs(tmp_path / name, picture)[1][0].read_bytes() for name in ("one", "two"))
    assert one == two


def test_a_png_shows_the_cameras_view_without_the_overscan(picture, wide, tmp_path):
    sharp, ample = (
        np.asarray(Image.open(pngs(tmp_path / str(each.overscan), each)[1][0])) for each in (picture, wide)
    )
    assert sharp.shape == ample.shape == (256, 192, 4)
    assert np.abs(sharp[..., 3].astype(int) - ample[..., 3]).max() <= 1
