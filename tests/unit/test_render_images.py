import struct
import subprocess
from fractions import Fraction

import numpy as np
import pytest
import torch
from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image

from dsar.errors import ExportError
from dsar.types import RenderOutput
from dsar_render import display_image, write_contact_sheet, write_mp4, write_png


@pytest.fixture
def output() -> RenderOutput:
    """Orange that covers the columns by 0, 1/2 and 1."""
    alpha = torch.tensor([0.0, 0.5, 1.0]).expand(2, 3)
    return RenderOutput(
        torch.tensor([1.0, 0.5, 0.0]) * alpha[..., None], alpha, torch.ones(2, 3), torch.tensor(0)
    )


def _decode(path, width, height) -> np.ndarray:
    command = [get_ffmpeg_exe(), "-loglevel", "error", "-i", str(path), "-f", "rawvideo"]
    raw = subprocess.run([*command, "-pix_fmt", "rgb24", "-"], check=True, capture_output=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)


def test_png_holds_straight_colour_and_alpha(output, tmp_path):
    pixels = np.asarray(Image.open(write_png(output, tmp_path / "png" / "a.png")))
    assert pixels[0].tolist() == [[0, 0, 0, 0], [255, 128, 0, 128], [255, 128, 0, 255]]


def test_display_image_is_the_blended_colour(output):
    assert display_image(output)[1].tolist() == [[0, 0, 0], [128, 64, 0], [255, 128, 0]]


@pytest.mark.parametrize("size", [(32, 48), (33, 47)], ids=["even", "odd"])
def test_video_decodes_to_the_colours_that_were_sent(tmp_path, size):
    colors = [(200, 60, 40), (40, 180, 70), (30, 50, 210)]
    images = [np.full((*size, 3), color, np.uint8) for color in colors]
    path = write_mp4(iter(images), tmp_path / "out.mp4", fps=23.976)
    decoded = _decode(path, size[1] + size[1] % 2, size[0] + size[0] % 2)
    # 8-bit YUV and crf 18 keep flat colours to about two levels; the wrong matrix is off by over ten.
    np.testing.assert_allclose(decoded.mean((1, 2)), colors, atol=3)
    assert list(tmp_path.iterdir()) == [path]


def test_video_is_8_bit_420_tagged_bt709(tmp_path):
    path = write_mp4([np.zeros((32, 32, 3), np.uint8)] * 2, tmp_path / "out.mp4", fps=24.0)
    # Asked for no output, ffmpeg prints what it found and exits with an error.
    command = [get_ffmpeg_exe(), "-i", str(path)]
    report = subprocess.run(command, check=False, capture_output=True, text=True).stderr
    assert "yuv420p(tv, bt709/bt709/iec61966-2-1" in report
    assert "24 fps" in report


@pytest.mark.parametrize(
    ("fps", "meant"), [(23.976, (24000, 1001)), (30000 / 1001, (30000, 1001)), (25.0, (25, 1))]
)
def test_video_plays_at_the_fraction_that_its_rate_stands_for(tmp_path, fps, meant):
    content = write_mp4([np.zeros((32, 32, 3), np.uint8)] * 2, tmp_path / "out.mp4", fps=fps).read_bytes()
    # ISO 14496-12: after name, version and two dates the media header has its timescale, ...
    (timescale,) = struct.unpack_from(">I", content, content.index(b"mdhd") + 16)
    # ... and after name, version and count the table of times how many frames last how long.
    frames, duration = struct.unpack_from(">II", content, content.index(b"stts") + 12)
    assert (Fraction(timescale, duration), frames) == (Fraction(*meant), 2)


@pytest.mark.parametrize(
    ("images", "message"),
    [
        ([], "expected at least one image"),
        ([np.zeros((8, 8, 3), np.uint8), np.zeros((8, 6, 3), np.uint8)], "render one size"),
    ],
    ids=["none", "mixed sizes"],
)
def test_unfit_images_make_no_video(tmp_path, images, message):
    with pytest.raises(ExportError, match=message):
        write_mp4(images, tmp_path / "out.mp4", fps=24.0)
    assert not list(tmp_path.iterdir())


def test_a_rate_that_ffmpeg_refuses_is_reported_in_its_words(tmp_path):
    with pytest.raises(ExportError, match=r"out\.mp4: ffmpeg stopped with code"):
        write_mp4([np.zeros((512, 512, 3), np.uint8)] * 9, tmp_path / "out.mp4", fps=-1.0)
    assert not list(tmp_path.iterdir())


def test_an_interrupted_video_leaves_nothing(tmp_path):
    def images():
        yield np.zeros((8, 8, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_mp4(images(), tmp_path / "out.mp4", fps=24.0)
    assert not list(tmp_path.iterdir())


def test_sheet_shows_every_image_untouched_and_in_its_row(tmp_path):
    rows = {
        "cam00 truth": [np.full((20, 90, 3), (level, 0, 0), np.uint8) for level in (50, 60)],
        "cam00 prediction": [np.full((20, 90, 3), (level, 0, 0), np.uint8) for level in (70, 80)],
    }
    path = write_contact_sheet(tmp_path / "sheet.png", rows, columns=["frame 1", "frame 2"])
    pixels = np.asarray(Image.open(path))
    where = {}
    for level in (50, 60, 70, 80):
        found = np.argwhere((pixels == (level, 0, 0)).all(-1))
        where[level] = found.min(0)
        assert len(found) == 20 * 90
        assert tuple(found.max(0) - found.min(0)) == (19, 89)
    assert where[50][0] == where[60][0] < where[70][0] == where[80][0]
    assert where[50][1] == where[70][1] < where[60][1] == where[80][1]


def test_a_row_with_a_missing_image_is_refused(tmp_path):
    with pytest.raises(ExportError, match=r"row truth: expected 2 images, found 1"):
        write_contact_sheet(
            tmp_path / "s.png", {"truth": [np.zeros((4, 4, 3), np.uint8)]}, columns=["a", "b"]
        )
