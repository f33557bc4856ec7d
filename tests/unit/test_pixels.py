"""Every kind of image file becomes the right pixels, or is refused with the real reason."""

import struct
import zlib

import numpy as np
import pytest
import torch
from PIL import Image, TiffImagePlugin
from profiles import P3, SRGB, ink_profile, rgb_profile

from dsar.color import linear_from_srgb, srgb_from_linear
from dsar.data.images.decoding import decode_mask_levels, decode_photograph
from dsar.errors import CaptureError
from dsar.types import Camera

H, W = 4, 6
RNG = np.random.default_rng(0)
COLOR = RNG.integers(0, 256, (H, W, 3), dtype=np.uint8)
MASK = np.where(np.arange(H * W).reshape(H, W) % 3, 0, 255).astype(np.uint8)
SOFT = RNG.integers(0, 256, (H, W), dtype=np.uint8)
CAMERA = Camera(torch.eye(3), torch.eye(4), W, H, "cam")
GREY = Image.fromarray(COLOR[..., 0])
# EXIF orientation: what shows a stored picture, by the standard's table.
SHOWN = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: np.rot90(a, 1),
}


def photograph(path, camera=CAMERA):
    found = decode_photograph(path, camera, str(path), mask=path)
    return found.color, " / ".join(note.what for note in found.notes)


def levels(path):
    found = decode_mask_levels(path, CAMERA)
    return found.values, " / ".join(note.what for note in found.notes)


def save(path, image, **options):
    (Image.fromarray(image) if isinstance(image, np.ndarray) else image).save(path, **options)
    return path


def png(depth, kind, pixels):
    """Return a PNG of a depth and colour type that Pillow does not write; pixels big-endian."""
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", W, H, depth, kind, 0, 0, 0)), (b"IDAT", zlib.compress(rows))]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in [*chunks, (b"IEND", b"")]
    )


def palette(mask, colors):
    """Return a picture of palette entries 0 and 1."""
    image = Image.fromarray((mask > 127).astype(np.uint8)).convert("P")
    image.putpalette([value for color in colors for value in color])
    return image


def rgba(color, alpha):
    return Image.fromarray(np.dstack([color, alpha]))


PALETTED = Image.fromarray(COLOR).quantize(16)
PHOTOGRAPHS = {
    "rgb.png": (Image.fromarray(COLOR), COLOR, ""),
    "opaque.png": (rgba(COLOR, np.full_like(MASK, 255)), COLOR, ""),
    "cutout.png": (rgba(COLOR, SOFT), COLOR, ""),
    "grey.png": (GREY, np.dstack([COLOR[..., 0]] * 3), "are grey"),
    "grey_alpha.png": (
        Image.merge("LA", [GREY, Image.fromarray(SOFT)]),
        np.dstack([COLOR[..., 0]] * 3),
        "are grey",
    ),
    "palette.png": (PALETTED, np.asarray(PALETTED.convert("RGB")), "have palettes"),
    "palette.gif": (PALETTED, np.asarray(PALETTED.convert("RGB")), "have palettes"),
    "deep.png": (
        Image.fromarray(COLOR[..., 0].astype(np.uint16) * 257),
        np.dstack([COLOR[..., 0]] * 3),
        "have 16 bits, of which the upper 8 are taken / are grey",
    ),
    "ycbcr.tif": (
        Image.fromarray(COLOR).convert("YCbCr"),
        np.asarray(Image.fromarray(COLOR).convert("YCbCr").convert("RGB")),
        "",
    ),
}


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_photographs_of_every_kind_become_their_colours_and_it_is_said(tmp_path, name):
    image, expected, note = PHOTOGRAPHS[name]
    color, said = photograph(save(tmp_path / name, image))
    assert np.array_equal(color, expected)
    assert said.startswith(note)
    assert bool(said) == bool(note)


def test_photographs_of_sixteen_bits_a_channel_keep_the_upper_eight(tmp_path):
    (tmp_path / "a.png").write_bytes(png(16, 2, COLOR.reshape(H, -1).astype(np.uint16) * 256 + 99))
    assert np.array_equal(photograph(tmp_path / "a.png")[0], COLOR)


@pytest.mark.parametrize(
    ("name", "image", "reason"),
    [
        ("a.jpg", Image.fromarray(COLOR).convert("CMYK"), r"printing inks \(CMYK\) without a colour profile"),
        ("a.tif", Image.fromarray(COLOR).convert("CMYK"), r"printing inks \(CMYK\) without a colour profile"),
        ("a.tif", Image.new("LAB", (W, H)), "CIELAB; save it as RGB"),
        ("a.tif", GREY.convert("I"), "32 bits"),
        ("a.tif", GREY.convert("F"), "floating-point numbers"),
        ("a.png", GREY.convert("1"), r"black and white alone \(a mask\?\)"),
    ],
)
def test_photographs_whose_colours_are_not_known_are_refused_by_kind(tmp_path, name, image, reason):
    with pytest.raises(CaptureError, match=rf"{name}: .*{reason}"):
        photograph(save(tmp_path / name, image))


@pytest.mark.parametrize("mode", [*Image.MODES, "I;16B", "PA", "La", "RGBa", "RGBX"])
@pytest.mark.parametrize("read", [photograph, levels])
def test_no_mode_of_pillow_is_without_a_fate(tmp_path, monkeypatch, mode, read):
    made = Image.new(mode, (W, H))
    made.format = "PNG"
    monkeypatch.setattr(Image, "open", lambda _: made)
    refused, found = "", np.zeros(0)
    try:
        found = read(tmp_path / "a.png")[0]
    except CaptureError as error:
        refused = str(error)
    assert ("save " in refused or "a mask?" in refused) == bool(refused)
    assert refused or (found.shape[:2] == (H, W) and found.dtype in (np.uint8, np.uint16))


@pytest.mark.parametrize("kind", ["jpg", "png", "tif", "webp"])
def test_a_wide_gamut_photograph_is_brought_to_srgb(tmp_path, kind):
    # Colours that sRGB holds, as Display P3 writes them.
    true = np.random.default_rng(1).integers(40, 216, (H, W, 3), dtype=np.uint8)
    stored = np.rint(255 * srgb_from_linear(linear_from_srgb(true / 255) @ SRGB @ np.linalg.inv(P3)))
    options = (
        {"quality": 100, "subsampling": 0} if kind == "jpg" else {"lossless": True} if kind == "webp" else {}
    )
    path = save(tmp_path / f"a.{kind}", stored.astype(np.uint8), icc_profile=rgb_profile(P3), **options)
    assert np.abs(stored - true).max() > 10, "or nothing is tested"
    color, said = photograph(path)
    assert np.abs(color.astype(int) - true).max() <= (12 if kind == "jpg" else 2)
    assert "have the colour profile" in said
    assert "brought to sRGB" in said


def test_srgbs_own_profile_changes_no_bit(tmp_path):
    path = save(tmp_path / "a.png", COLOR, icc_profile=rgb_profile())
    assert photograph(path) == (pytest.approx(COLOR, abs=0), "")


def test_a_spoilt_profile_is_told_of_and_the_colours_stay(tmp_path):
    color, said = photograph(save(tmp_path / "a.png", COLOR, icc_profile=b"no profile" * 30))
    assert np.array_equal(color, COLOR)
    assert "cannot be used" in said


def test_inks_with_a_profile_become_the_colours_that_it_prints(tmp_path):
    # A paper on which inks make greys alone: Pillow's own conversion would give colours.
    profile = ink_profile(lambda c, m, y, k: (100 - 30 * c - 20 * m - 10 * y - 35 * k, 0, 0))
    inks = np.zeros((H, W, 4), np.uint8)
    inks[0, :5] = np.vstack([np.zeros(4), 255 * np.eye(4)])
    image = Image.frombytes("CMYK", (W, H), inks.tobytes())
    color, said = photograph(save(tmp_path / "a.tif", image, icc_profile=profile))
    lightness = np.array([100, 70, 80, 90, 65])
    expected = 255 * srgb_from_linear(((lightness + 16) / 116) ** 3)
    assert np.abs(color[0, :5] - expected[:, None]).max() < 3
    assert "inks" in said


@pytest.mark.parametrize("kind", ["jpg", "png", "tif", "webp"])
@pytest.mark.parametrize("orientation", SHOWN)
def test_exif_orientation_is_followed_as_viewers_do(tmp_path, kind, orientation):
    blocks = np.kron(COLOR, np.ones((16, 16, 1), np.uint8))
    camera = Camera(torch.eye(3), torch.eye(4), 16 * W, 16 * H, "cam")
    back = {6: 8, 8: 6}.get(orientation, orientation)
    stored = np.ascontiguousarray(SHOWN[back](blocks))
    exif = Image.Exif()
    exif[0x112] = orientation
    options = (
        {"quality": 100, "subsampling": 0} if kind == "jpg" else {"lossless": True} if kind == "webp" else {}
    )
    path = save(tmp_path / f"a.{kind}", stored, exif=exif, **options)
    color, said = photograph(path, camera)
    assert np.abs(color.astype(int) - blocks).max() <= (4 if kind == "jpg" else 0)
    assert said.startswith(f"have EXIF orientation {orientation} and are turned") == (orientation > 1)


def test_a_quarter_turn_that_would_not_fit_the_camera_is_not_done(tmp_path):
    exif = Image.Exif()
    exif[0x112] = 6
    color, said = photograph(save(tmp_path / "a.png", COLOR, exif=exif))
    assert np.array_equal(color, COLOR)
    assert "orientation 6, not applied" in said


def test_masks_are_turned_as_photographs_are(tmp_path):
    exif = Image.Exif()
    exif[0x112] = 3
    path = save(tmp_path / "a.png", np.ascontiguousarray(SOFT[::-1, ::-1]), exif=exif)
    assert np.array_equal(levels(path)[0], SOFT)


GREYS = [(0, 0, 0), (255, 255, 255)]
MASKS = {
    "one_bit.png": (Image.fromarray(MASK > 127), MASK, ""),
    "soft.png": (Image.fromarray(SOFT), SOFT, ""),
    "rgb.png": (Image.fromarray(np.dstack([SOFT] * 3)), SOFT, ""),
    "opaque.png": (rgba(np.dstack([SOFT] * 3), np.full_like(SOFT, 255)), SOFT, ""),
    "white_alpha.png": (rgba(np.full((H, W, 3), 255, np.uint8), SOFT), SOFT, "in their alpha"),
    "black_alpha.png": (rgba(np.zeros((H, W, 3), np.uint8), SOFT), SOFT, "in their alpha"),
    "cutout.png": (rgba(COLOR, SOFT), SOFT, "in their alpha"),
    "nobody_alpha.png": (rgba(np.full((H, W, 3), 255, np.uint8), 0 * SOFT), 0 * SOFT, "in their alpha"),
    "grey_alpha.png": (
        Image.merge("LA", [Image.new("L", (W, H), 255), Image.fromarray(SOFT)]),
        SOFT,
        "alpha",
    ),
    "palette.png": (palette(MASK, GREYS), MASK, ""),
    "red.png": (palette(MASK, [(0, 0, 0), (128, 0, 0)]), MASK, "#800000 on black"),
    "green.png": (palette(MASK, [(0, 0, 0), (0, 255, 0)]), MASK, "#00ff00 on black"),
    "blue.tif": (palette(MASK, [(0, 0, 0), (0, 0, 1)]), MASK, "#000001 on black"),
    "deep.png": (Image.fromarray(SOFT.astype(np.uint16) * 257), SOFT.astype(np.uint16) * 257, ""),
}


@pytest.mark.parametrize("name", MASKS)
def test_masks_of_every_kind_become_coverage(tmp_path, name):
    image, expected, note = MASKS[name]
    found, said = levels(save(tmp_path / name, image))
    assert np.array_equal(found, expected)
    assert note in said
    assert bool(said) == bool(note)


def test_a_transparent_palette_entry_is_the_background(tmp_path):
    path = save(tmp_path / "a.png", palette(MASK, [(9, 9, 9), (9, 9, 9)]), transparency=0)
    assert np.array_equal(levels(path)[0], MASK)


def test_a_jpeg_of_a_mask_rings_and_is_one_all_the_same(tmp_path):
    large = np.kron(MASK, np.ones((8, 8), np.uint8))
    camera = Camera(torch.eye(3), torch.eye(4), 8 * W, 8 * H, "cam")
    path = save(tmp_path / "a.jpg", np.dstack([large] * 3), quality=60)
    assert np.array_equal(decode_mask_levels(path, camera).values > 127, large > 127)


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (Image.fromarray(COLOR), "is no mask: its channels differ, and it has 24 colours"),
        (rgba(np.dstack([SOFT] * 3), 255 - SOFT), "its grey and its alpha differ"),
        (palette(MASK, [(7, 7, 7), (7, 7, 7)]), "all its palette's entries have one colour"),
        (palette(MASK, [(255, 0, 0), (0, 0, 255)]), "its channels differ, and it has 2 colours"),
        (GREY.convert("F"), "floating-point numbers"),
        (GREY.convert("CMYK"), "printing inks"),
    ],
)
def test_what_is_no_mask_is_refused_with_the_reason(tmp_path, image, reason):
    with pytest.raises(CaptureError, match=rf"mask .*a\.tif: .*{reason}"):
        levels(save(tmp_path / "a.tif", image))


@pytest.mark.parametrize(
    ("size", "hint"),
    [
        ((W // 2, H // 2), r"found 3x2; it is the same picture at 0\.5 times the size: give images of"),
        ((2 * W, 2 * H), r"found 12x8; it is the same picture at 2 times"),
        ((H, W), r"found 4x6; they are turned by a quarter"),
        ((W, H + 3), r"found 6x7; it is another camera's, or was cut"),
    ],
)
def test_another_size_is_refused_with_what_it_looks_like(tmp_path, size, hint):
    path, mask = (
        save(tmp_path / "a.png", Image.new("RGB", size)),
        save(tmp_path / "m.png", Image.fromarray(MASK)),
    )
    with pytest.raises(
        CaptureError, match=rf"expected 6x4 pixels as camera cam says, {hint}.*its mask has 6x4"
    ):
        decode_photograph(path, CAMERA, str(path), mask)


def animation(path):
    frames = [Image.fromarray(COLOR), Image.fromarray(255 - COLOR)]
    frames[0].save(path, save_all=True, append_images=frames[1:])


FILES = {
    "empty.jpg": (lambda path: path.write_bytes(b""), r"it is empty \(0 bytes\)"),
    "page.jpg": (lambda path: path.write_text("\n<!DOCTYPE html><html>404</html>"), "a web page"),
    "phone.jpg": (lambda path: path.write_bytes(b"\0\0\0\x18ftypheic" + bytes(90)), "a HEIC photograph"),
    "clip.jpg": (lambda path: path.write_bytes(b"\0\0\0\x18ftypisom" + bytes(90)), r"a video \(MP4, MOV\)"),
    "lfs.png": (lambda path: path.write_text("version https://git-lfs.github.com/spec/v1\n"), "git lfs pull"),
    "zeros.png": (lambda path: path.write_bytes(bytes(5000)), "a copy that was cut short"),
    "packed.png": (lambda path: path.write_bytes(b"PK\x03\x04" + bytes(90)), "a zip archive"),
    "words.png": (lambda path: path.write_text("Access denied\n"), "text that begins with 'Access denied'"),
    "._a.png": (lambda path: path.write_bytes(b"\0\5\x16\7" + bytes(90)), "no image that we know"),
    "moving.gif": (animation, "expected one picture, found 2 in a GIF"),
    "pages.tif": (animation, "expected one picture, found 2 in a TIFF"),
    "moving.webp": (animation, "expected one picture, found 2 in a WEBP"),
}


@pytest.mark.parametrize("name", FILES)
def test_what_is_no_still_image_is_named_by_what_it_is(tmp_path, name):
    write, reason = FILES[name]
    write(tmp_path / name)
    for read in (photograph, levels):
        with pytest.raises(CaptureError, match=rf"{name}: .*{reason}") as caught:
            read(tmp_path / name)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["jpg", "png", "tif", "webp"])
def test_a_file_that_ends_early_is_refused(tmp_path, kind):
    path = save(tmp_path / f"a.{kind}", np.kron(COLOR, np.ones((16, 16, 1), np.uint8)))
    path.write_bytes(path.read_bytes()[: -path.stat().st_size // 3])
    camera = Camera(torch.eye(3), torch.eye(4), 16 * W, 16 * H, "cam")
    with pytest.raises(CaptureError, match=rf"a\.{kind}: cannot be decoded"):
        photograph(path, camera)


def tiff(bits, number, data):
    """Return a TIFF of RGB that Pillow does not write; `number` is 1 for whole numbers and 3 for floats."""
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[256], tags[257], tags[258], tags[259], tags[262] = W, H, (bits,) * 3, 1, 2
    tags[273], tags[277], tags[278], tags[279], tags[339] = 0, 3, H, len(data), (number,) * 3
    # Pillow moves the strip's offset, here 0, behind the tags.
    return b"II*\0" + struct.pack("<I", 8) + tags.tobytes(8) + data


def test_tiffs_of_sixteen_bits_a_channel_keep_eight_and_of_floats_are_named(tmp_path):
    (tmp_path / "a.tif").write_bytes(tiff(16, 1, (COLOR.astype("<u2") * 256 + 99).tobytes()))
    assert np.array_equal(photograph(tmp_path / "a.tif")[0], COLOR)
    (tmp_path / "a.tif").write_bytes(tiff(32, 3, (COLOR / 255).astype("<f4").tobytes()))
    with pytest.raises(CaptureError, match=r"a\.tif: .*a TIFF of a kind that Pillow does not read"):
        photograph(tmp_path / "a.tif")


def test_a_jpeg_with_previews_behind_it_is_its_first_picture(tmp_path):
    image = Image.fromarray(np.kron(COLOR, np.ones((8, 8, 1), np.uint8)))
    camera = Camera(torch.eye(3), torch.eye(4), 8 * W, 8 * H, "cam")
    image.save(tmp_path / "a.jpg", "MPO", save_all=True, append_images=[image.resize((9, 9))], quality=100)
    color, _ = photograph(tmp_path / "a.jpg", camera)
    assert np.abs(color.astype(int) - np.asarray(image)).mean() < 8
