"""Eight-bit images for people to look at; a compositor gets EXR instead."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, UnidentifiedImageError
from PIL.PngImagePlugin import PngInfo
from torch import Tensor

from dsar.atomic_files import atomic_write
from dsar.types import Camera, Picture, RenderOutput

# Below this coverage an 8-bit alpha is zero and a straight colour is noise.
_MIN_ALPHA = 0.5 / 255
_JOB = "dsar/job"
"""Text chunk of a PNG that names the job it comes from."""
_LAST_CHUNK = b"IEND\xaeB`\x82"


def display_image(output: RenderOutput) -> UInt8[np.ndarray, "h w 3"]:
    """Return sRGB over the background that was rendered, or over black if none was."""
    return _to_uint8(output.color.detach().cpu().numpy())


def composite_over(output: RenderOutput, background: float) -> RenderOutput:
    """Return an image that was rendered without a background over a grey one, display-referred."""
    return dataclasses.replace(output, color=output.color + (1 - output.alpha[..., None]) * background)


@dataclass(frozen=True)
class PngSequence:
    """PNG files for people: `folder/<camera>/<name>.<camera>.%04d.png`, display-referred, straight alpha."""

    folder: Path
    name: str = "avatar"

    @property
    def key(self) -> str:
        """All settings that files depend on, besides their place."""
        return self.name

    @property
    def combines_cameras(self) -> bool:
        """Whether all cameras of a frame go into one file."""
        return False

    def check(self, cameras: Sequence[Camera]) -> None:
        """Accept any cameras."""

    def write(self, pictures: Sequence[Picture], job_hashes: Sequence[str]) -> list[Path]:
        """Write a frame's pictures; each file depends on all that its job's hash is of."""
        paths = [self._path(picture.frame, picture.camera.name) for picture in pictures]
        for path, picture, job_hash in zip(paths, pictures, job_hashes, strict=True):
            write_png(crop_overscan(picture), path, job_hash=job_hash)
        return paths

    def is_complete(self, frame: int, cameras: Sequence[str], job_hashes: Sequence[str], deep: bool) -> bool:
        """Return whether a frame's files are there, whole, and from these very jobs; none is ever deep."""
        return all(
            _comes_from(self._path(frame, camera), job_hash)
            for camera, job_hash in zip(cameras, job_hashes, strict=True)
        )

    def _path(self, frame: int, camera: str) -> Path:
        return self.folder / camera / f"{self.name}.{camera}.{frame:04d}.png"


def write_png(output: RenderOutput, path: Path, *, job_hash: str = "") -> Path:
    """Write an 8-bit sRGB PNG with straight (not premultiplied) alpha and return its path.

    Args:
        output: Rendered without a background.
        path: The file, which appears when it is complete; folders are made if missing.
        job_hash: Written into the file, if given.
    """
    text = PngInfo()
    if job_hash:
        text.add_text(_JOB, job_hash)
    color, alpha = output.color.detach().cpu().numpy(), output.alpha.detach().cpu().numpy()
    coverage = alpha[..., None]
    straight = np.divide(color, coverage, out=np.zeros_like(color), where=coverage >= _MIN_ALPHA)
    with atomic_write(path) as draft:
        Image.fromarray(_to_uint8(np.concatenate([straight, coverage], -1))).save(
            draft, format="PNG", pnginfo=text
        )
    return path


def crop_overscan(picture: Picture) -> RenderOutput:
    """Return the camera's own view: a PNG has no pixels beyond it."""
    margin, output = picture.overscan, picture.output
    if not margin:
        return output
    inside = slice(margin, -margin)
    images = {
        name: value for name, value in vars(output).items() if isinstance(value, Tensor) and value.ndim > 1
    }
    return dataclasses.replace(output, **{name: image[inside, inside] for name, image in images.items()})


def _comes_from(path: Path, job_hash: str) -> bool:
    """Return whether a PNG is whole and comes from a job."""
    try:
        # Readers do without the last chunk.
        if not path.read_bytes().endswith(_LAST_CHUNK):
            return False
        with Image.open(path) as image:
            image.load()
            return image.info.get(_JOB) == job_hash
    except (OSError, UnidentifiedImageError, SyntaxError):
        return False


def _to_uint8(values: Float[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    """Return values of 0..1 as 0..255, rounded to nearest."""
    return (values.clip(0, 1) * 255 + 0.5).astype(np.uint8)
