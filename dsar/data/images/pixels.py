"""Pixels of image files: every mode of Pillow has a stated fate, for photographs and for masks.

What is converted without doubt is converted, and a note says so; what is doubtful is refused.
"""

import io
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16
from PIL import ExifTags, Image, ImageCms, ImageOps, UnidentifiedImageError

from dsar.data.images.conversions import Note
from dsar.data.images.file_signatures import describe_file
from dsar.errors import CaptureError

# What Pillow raises on damaged files of the formats that captures use.
_DAMAGE = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    LookupError,
    OverflowError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
    Image.DecompressionBombWarning,
)
_DEEP = ("I;16", "I;16B", "I;16L", "I;16N")
_COLORS = ("RGB", "RGBA", "RGBX", "YCbCr")
_GREYS = ("L", "LA")
_PALETTES = ("P", "PA")
_QUARTERS = (5, 6, 7, 8)
"""EXIF orientations that exchange width and height."""
_SAME = 2
"""Levels by which a profile must move colours to be another space than sRGB."""
_ROUGH = 32
"""Levels by which JPEG may set the channels of a grey pixel apart."""
_FEW = 0.005
"""Share of pixels in which it may do so by more."""
_REASONS = {
    "CMYK": "printing inks (CMYK) without a colour profile, whose colours cannot be known; save it as RGB",
    "LAB": "CIELAB; save it as RGB",
    "HSV": "HSV; save it as RGB",
    "I": "whole numbers of 32 bits, whose white is not known; save it with 8 or 16 bits",
    "F": "floating-point numbers, whose white is not known; save it with 8 or 16 bits",
}


@dataclass(frozen=True)
class Photograph:
    """Colours as sRGB, and what a file says of coverage."""

    color: UInt8[np.ndarray, "h w 3"]
    alpha: UInt8[np.ndarray, "h w"] | None
    """Its alpha, where it has one."""
    notes: Sequence[Note]


@dataclass(frozen=True)
class MaskLevels:
    """A mask's numbers as the file has them."""

    values: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]
    notes: Sequence[Note]


@contextmanager
def open_image(data: bytes | Path, where: str) -> Iterator[Image.Image]:
    """Open a still image whose pixels are not read yet.

    Raises:
        CaptureError: it is none, is damaged (also where the block finds out), or holds several pictures.
    """
    try:
        with Image.open(io.BytesIO(data) if isinstance(data, bytes) else data) as image:
            frames = getattr(image, "n_frames", 1)
            # An MPO is a JPEG with previews behind it.
            if frames > 1 and image.format != "MPO":
                raise CaptureError(
                    f"image {where}: expected one picture, found {frames} in a {image.format}; save each "
                    "as a file of its own"
                )
            yield image
    except CaptureError:
        raise
    except UnidentifiedImageError as error:
        raise CaptureError(f"image {where}: cannot be decoded; it is {describe_file(data)}") from error
    except _DAMAGE as error:
        system = getattr(error, "strerror", None)
        fault = f"cannot be read ({system})" if system else f"cannot be decoded ({error})"
        raise CaptureError(f"image {where}: {fault}") from error


def apply_orientation(image: Image.Image, size: tuple[int, int]) -> Image.Image:
    """Return an image as viewers show it, by EXIF orientation, unless `check_orientation` says otherwise."""
    turned = _is_turned(image, size) and image.format != "TIFF"
    image.load()
    # Pillow turns a TIFF while it decodes it.
    return ImageOps.exif_transpose(image) if turned else image


def check_orientation(image: Image.Image, size: tuple[int, int]) -> list[Note]:
    """Return what is done about an image's EXIF orientation.

    A quarter turn after which the image had not its camera's size, but has before, is not done: then the
    calibration is of the picture as it is stored.
    """
    orientation = _orientation(image)
    if orientation == 1:
        return []
    if not _is_turned(image, size):
        return [
            Note(
                f"have EXIF orientation {orientation}, not applied: as they are stored they fit their camera"
            )
        ]
    what = f"have EXIF orientation {orientation} and are turned by it, as viewers show them"
    return [Note(what, doubtful=orientation not in _QUARTERS)]


def displayed_size(image: Image.Image) -> tuple[int, int]:
    """Return width and height as viewers show an image."""
    quarter = image.format != "TIFF" and _orientation(image) in _QUARTERS
    return (image.height, image.width) if quarter else image.size


def check_photograph_mode(image: Image.Image, where: str) -> list[Note]:
    """Return what `read_photograph` will convert, by an image's header.

    Raises:
        CaptureError: its mode is no photograph's.
    """
    mode, profile, notes = image.mode, image.info.get("icc_profile"), []
    if mode == "1":
        raise CaptureError(f"image {where}: expected a photograph, found black and white alone (a mask?)")
    if mode not in (*_COLORS, *_GREYS, *_DEEP, *_PALETTES, *(["CMYK"] if profile else [])):
        raise CaptureError(
            f"image {where}: is of {_REASONS.get(mode, f'Pillow mode {mode}; save it as RGB')}"
        )
    if mode in _DEEP:
        notes.append(Note("have 16 bits, of which the upper 8 are taken"))
    if mode in _PALETTES:
        notes.append(Note("have palettes; their colours are taken"))
    if mode in _GREYS or mode in _DEEP:
        notes.append(Note("are grey: so will be the avatar", doubtful=True))
    if profile is not None:
        note = _from_profile(profile, _plain_mode(mode), where)[1]
        notes += [note] if note else []
    return notes


def read_photograph(image: Image.Image, where: str) -> Photograph:
    """Return colours as sRGB of 8 bits, from an image that is upright.

    Raises:
        CaptureError: its mode is no photograph's.
    """
    notes, profile, mode = check_photograph_mode(image, where), image.info.get("icc_profile"), image.mode
    if mode in _PALETTES:
        image = image.convert("RGBA" if mode == "PA" or "transparency" in image.info else "RGB")
    alpha = np.asarray(image.getchannel("A")) if image.mode in ("RGBA", "LA") else None
    if mode in _DEEP:
        image = Image.fromarray((np.asarray(image).astype(np.uint16) >> 8).astype(np.uint8))
    image = image.convert(_plain_mode(mode))
    if profile is not None:
        transform = _from_profile(profile, image.mode, where)[0]
        image = (ImageCms.applyTransform(image, transform) if transform else None) or image
    return Photograph(np.asarray(image.convert("RGB")), alpha, notes)


def _plain_mode(mode: str) -> str:
    """Return the mode in which a photograph's colours are converted: grey, RGB or CMYK."""
    return "L" if mode in (*_GREYS, *_DEEP) else "CMYK" if mode == "CMYK" else "RGB"


def read_mask_levels(image: Image.Image, where: str) -> MaskLevels:
    """Return a mask's numbers, from an image that is upright: its alpha where the mask lies in it.

    Raises:
        CaptureError: it is no mask, or it is not clear which of its channels is.
    """
    mode = image.mode
    if mode == "1":
        return MaskLevels(np.asarray(image).astype(np.uint8) * np.uint8(255), ())
    if mode == "L" and "transparency" not in image.info:
        return MaskLevels(np.asarray(image), ())
    if mode in _DEEP:
        return MaskLevels(np.asarray(image).astype(np.uint16), ())
    if mode not in (*_COLORS, *_GREYS, *_PALETTES):
        raise CaptureError(
            f"mask {where}: is of {_REASONS.get(mode, f'Pillow mode {mode}; save it as grey')}"
        )
    if mode in ("RGB", "RGBX", "YCbCr") and "transparency" not in image.info:
        return _of_color(np.asarray(image.convert("RGB")), where)
    rgba = np.asarray(image.convert("RGBA"))
    color, alpha = rgba[..., :3], rgba[..., 3]
    plain = bool((color == color[0, 0]).all())
    if plain and mode == "P" and alpha.min() == 255 and np.ptp(np.asarray(image)):
        raise CaptureError(f"mask {where}: all its palette's entries have one colour; save it as grey")
    if alpha.min() == alpha.max() and (alpha[0, 0] == 255 or not plain):
        return _of_color(color, where)
    if (
        not plain
        and bool((color == color[..., :1]).all())
        and np.abs(color[..., 0].astype(int) - alpha).mean() > 1
    ):
        raise CaptureError(
            f"mask {where}: its grey and its alpha differ, and either may be the mask; save that one as grey"
        )
    return MaskLevels(alpha, (Note("have the mask in their alpha, which is taken"),))


def _of_color(color: UInt8[np.ndarray, "h w 3"], where: str) -> MaskLevels:
    """Return the levels of a mask that was saved with colours: grey ones, or one colour on black."""
    if (color[..., 1:] == color[..., :1]).all():
        return MaskLevels(np.ascontiguousarray(color[..., 0]), ())
    packed = (color * np.array([1 << 16, 1 << 8, 1], np.uint32)).sum(-1, dtype=np.uint32)
    person = packed > 0
    value = int(packed.max())
    if not person.all() and (packed[person] == value).all():
        note = Note(f"are #{value:06x} on black: #{value:06x} is the person")
        return MaskLevels(np.where(person, np.uint8(255), np.uint8(0)), (note,))
    # JPEG sets the channels of grey pixels apart.
    sample_frames = color.max(-1) - color.min(-1)
    if (sample_frames > _ROUGH).mean() <= _FEW and np.median(sample_frames) <= 2:
        return MaskLevels(np.ascontiguousarray(color[..., 0]), ())
    raise CaptureError(
        f"mask {where}: is no mask: its channels differ, and it has {len(np.unique(packed))} colours; save "
        "the person as white, the rest as black"
    )


def _orientation(image: Image.Image) -> int:
    """Return an image's EXIF orientation, 1 to 8; 1 where it has none that can be read."""
    try:
        orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
    except _DAMAGE:
        return 1
    return orientation if orientation in range(1, 9) else 1


def _is_turned(image: Image.Image, size: tuple[int, int]) -> bool:
    """Return whether an image of a camera's size is turned by its EXIF orientation."""
    return _orientation(image) != 1 and displayed_size(image) == size


def _from_profile(
    profile: bytes, mode: str, where: str
) -> tuple[ImageCms.ImageCmsTransform | None, Note | None]:
    """Return what brings colours from a profile to sRGB, None if nothing need be done, and a note."""
    try:
        transform, name, same = _transform(profile, mode)
    except (ImageCms.PyCMSError, OSError, ValueError) as error:
        if mode == "CMYK":
            raise CaptureError(
                f"image {where}: is of printing inks (CMYK) with a colour profile that cannot be used "
                f"({error}); save it as RGB"
            ) from error
        return None, Note(
            f"have a colour profile that cannot be used ({error}): taken as sRGB", doubtful=True
        )
    if same:
        return None, None
    return transform, Note(f"have the colour profile {name!r} and are brought to sRGB")


@lru_cache(maxsize=16)
def _transform(profile: bytes, mode: str) -> tuple[ImageCms.ImageCmsTransform, str, bool]:
    """Return the transform from a profile to sRGB, its name, and whether it does next to nothing."""
    source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    transform = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, "RGB")
    name = ImageCms.getProfileDescription(source).strip()
    if mode == "CMYK":
        return transform, name, False
    steps = np.linspace(0, 255, 6).astype(np.uint8)
    cube = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(1, -1, 3)
    probe = Image.fromarray(cube).convert(mode)
    moved = np.abs(
        np.asarray(ImageCms.applyTransform(probe, transform)).astype(int) - np.asarray(probe.convert("RGB"))
    )
    return transform, name, bool(moved.max() <= _SAME)
