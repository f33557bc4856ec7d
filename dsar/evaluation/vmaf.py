"""VMAF (Li et al. 2016, version 0.6.1): how good a video looks beside the true one, 0 to about 100.

Its model was fitted to television pictures, so that figures of other sizes compare with their like only.
"""

import importlib.util
import json
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from dsar.errors import MissingDependencyError

_MULTIPLE = 2


def vmaf_missing() -> str | None:
    """Return why VMAF cannot be computed here, or None."""
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        return 'package imageio-ffmpeg is missing: pip install "dsar-avatar[video]"'
    return None


def vmaf(images: Iterable[UInt8[np.ndarray, "h w 3"]], truths: Iterable[UInt8[np.ndarray, "h w 3"]]) -> float:
    """Return the mean VMAF of display-referred frames against the true ones.

    Width and height are cut to even numbers, as the 4:2:0 colours that it looks at need.

    Raises:
        MissingDependencyError: imageio-ffmpeg, whose ffmpeg has VMAF built in, is not installed.
        ValueError: frames are missing or differ in size.
    """
    if vmaf_missing():
        raise MissingDependencyError("VMAF", "imageio-ffmpeg", "video")
    from imageio_ffmpeg import get_ffmpeg_exe

    with tempfile.TemporaryDirectory() as folder:
        shapes = [
            _write(frames, Path(folder) / name) for frames, name in ((images, "made"), (truths, "true"))
        ]
        if shapes[0] != shapes[1]:
            raise ValueError(
                f"videos of {shapes[0]} and {shapes[1]} (frames, height, width) cannot be compared"
            )
        _, height, width = shapes[0]
        raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
        yuv = "format=yuv420p"
        compare = f"[0]{yuv}[a];[1]{yuv}[b];[a][b]libvmaf=log_fmt=json:log_path=found.json"
        command = [get_ffmpeg_exe(), "-v", "error", *raw, "-i", "made", *raw, "-i", "true"]
        # In the folder, because a filter's argument has no safe way to hold a path.
        subprocess.run([*command, "-lavfi", compare, "-f", "null", "-"], cwd=folder, check=True)
        report = json.loads((Path(folder) / "found.json").read_text())
    return float(report["pooled_metrics"]["vmaf"]["mean"])


def _write(frames: Iterable[UInt8[np.ndarray, "h w 3"]], path: Path) -> tuple[int, int, int]:
    """Write frames one after another; return their number, height and width."""
    sizes, count = set(), 0
    with path.open("wb") as file:
        for frame in frames:
            height, width = (size - size % _MULTIPLE for size in frame.shape[:2])
            file.write(np.ascontiguousarray(frame[:height, :width]).tobytes())
            sizes.add((height, width))
            count += 1
    if len(sizes) != 1:
        raise ValueError(f"a video needs frames of one size, found {sorted(sizes) or 'none'}")
    return count, *sizes.pop()
