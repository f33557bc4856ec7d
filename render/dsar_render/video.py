"""Videos for review, through the ffmpeg that imageio-ffmpeg carries."""

import errno
import itertools
import os
import signal
import subprocess
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from dsar.atomic_files import atomic_write, find_quoted_os_error
from dsar.errors import ExportError, MissingDependencyError
from dsar.geometry.frame_rates import exact_rate


def write_mp4(images: Iterable[UInt8[np.ndarray, "h w 3"]], path: Path, *, fps: float) -> Path:
    """Write images as an H.264 video that every player and browser shows, and return its path.

    Display-referred sRGB in, 4:2:0 with BT.709 matrix out and tagged so. An odd width or height gains a
    copy of its last column or row. One image is in memory at a time; the file appears when it is complete.

    Args:
        images: Frames of one size, in order.
        path: The file; folders are made if missing.
        fps: Frames per second; NTSC rates such as 23.976 are written as their exact fractions.

    Raises:
        ExportError: There are no images, their sizes differ, or ffmpeg fails.
        MissingDependencyError: imageio-ffmpeg is not installed.
    """
    ffmpeg = _find_ffmpeg()
    frames = iter(images)
    first = next(frames, None)
    if first is None:
        raise ExportError(f"{path.name}: expected at least one image, found none: widen the frame range")
    with atomic_write(path) as draft:
        command = [ffmpeg, *_encoder_arguments(first, draft, fps)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as encoder:
            try:
                _feed(encoder, itertools.chain([first], frames), first.shape)
            except BrokenPipeError:
                pass  # ffmpeg gave up; its log and exit code say why
            except BaseException:
                encoder.kill()
                encoder.communicate()
                raise
            log = encoder.communicate()[1].decode(errors="replace").strip()
        if encoder.returncode == -signal.SIGXFSZ:
            raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
        if encoder.returncode:
            failed = ExportError(f"{path}: ffmpeg stopped with code {encoder.returncode}: {log}")
            raise find_quoted_os_error(log) or failed
    return path


def _feed(
    encoder: subprocess.Popen[bytes],
    images: Iterable[UInt8[np.ndarray, "h w 3"]],
    shape: tuple[int, ...],
) -> None:
    """Send the images to the encoder; raise ExportError at one of another shape."""
    assert encoder.stdin is not None
    for image in images:
        if image.shape != shape:
            raise ExportError(f"video: expected images of {shape}, found {image.shape}: render one size")
        encoder.stdin.write(_pad_to_even(image).tobytes())


def _find_ffmpeg() -> str:
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        raise MissingDependencyError("video", "imageio-ffmpeg", "video") from error
    return get_ffmpeg_exe()


def _encoder_arguments(image: UInt8[np.ndarray, "h w 3"], path: Path, fps: float) -> list[str]:
    height, width = _pad_to_even(image).shape[:2]
    source = f"-f rawvideo -pixel_format rgb24 -video_size {width}x{height} -framerate {exact_rate(fps)}"
    # Without an explicit matrix ffmpeg converts by BT.601 and players decode by BT.709.
    convert = "scale=out_color_matrix=bt709:out_range=tv,format=yuv420p"
    tag = "setparams=colorspace=bt709:color_primaries=bt709:color_trc=iec61966-2-1"
    options = (
        f"-loglevel error -y {source} -i - -vf {convert},{tag} -c:v libx264 -crf 18 -movflags +faststart"
    )
    return [*options.split(), "-f", "mp4", str(path)]


def _pad_to_even(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Return the image with even height and width, which 4:2:0 needs."""
    height, width = image.shape[:2]
    return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
