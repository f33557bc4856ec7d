"""What a capture's files hold: every image is read, times and speeds are counted."""

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import blake2b

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from dsar.avatar.driving import find_jumps
from dsar.color import linear_from_srgb
from dsar.data.captures.multiview import MultiViewCapture
from dsar.data.motions.kinematics import JointTrajectories
from dsar.errors import CaptureError
from dsar.types import Body

_THREADS = 2
_MOVING = 0.05
_RIM = 0.05
_SKIPPED = 4
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_EDGES = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)


ImageIndex = tuple[str, int, int]
"""Sequence, frame, and camera by its index in the capture."""


@dataclass(frozen=True)
class ImageSummary:
    """What is kept of an image that was read."""

    sequence: str
    frame: int
    camera: int
    """Index in the capture."""
    digest: bytes
    """Tells whether two images are the same."""
    coverage: float
    """Share of the image that the mask covers."""
    border: float
    """Share of the image's border that it covers."""
    full: bool
    """Whether it covers everything, but for a rim that undistortion may have left."""
    highest: int
    """The mask's highest number, 0 to 255."""
    light: float
    """Mean luminance of the person, linear, 0 to 1; 0 without one."""
    chroma: float
    """Mean distance between the channels of the person's pixels, 0 to 255; 0 without one."""
    broken: str | None = None
    """Why it cannot be read."""


def summarize_images(
    capture: MultiViewCapture, places: Sequence[ImageIndex] | None = None
) -> Iterator[ImageSummary]:
    """Yield images of a capture: every one, sequence by sequence and camera by camera, or those of places."""

    def load(place: ImageIndex) -> ImageSummary:
        try:
            image = capture.image(*place)
        except CaptureError as error:
            return ImageSummary(*place, b"", 0.0, 0.0, False, 0, 0.0, 0.0, str(error))
        digest = blake2b(image.tobytes(), digest_size=16).digest()
        return ImageSummary(
            *place, digest, *_cover(image[..., 3]), int(image[..., 3].max()), *_describe(image)
        )

    with ThreadPoolExecutor(_THREADS) as threads:
        yield from threads.map(load, _all_images(capture) if places is None else places)


def _all_images(capture: MultiViewCapture) -> list[ImageIndex]:
    places = []
    for name, motion in capture.motions.items():
        seen = [capture.cameras_with_image(name, frame) for frame in range(len(motion))]
        by_camera = sorted((index, frame) for frame, cameras in enumerate(seen) for index in cameras)
        places += [(name, frame, index) for index, frame in by_camera]
    return places


def count_images(capture: MultiViewCapture) -> int:
    """Return how many images a capture has."""
    return sum(
        len(capture.cameras_with_image(name, frame))
        for name, motion in capture.motions.items()
        for frame in range(len(motion))
    )


def count_duplicates(
    joints: Mapping[str, JointTrajectories], summaries: Sequence[ImageSummary]
) -> dict[int, int]:
    """Return how many images of each camera equal the one before, though the body moved.

    Args:
        joints: The body's, by sequence.
        summaries: Of all images, sequence by sequence and camera by camera.
    """
    moving = {name: (trajectories.speeds > _MOVING).tolist() for name, trajectories in joints.items()}
    counts: Counter[int] = Counter()
    for before, now in itertools.pairwise(summaries):
        follows = (before.sequence, before.camera, before.frame + 1) == (now.sequence, now.camera, now.frame)
        if follows and now.digest and before.digest == now.digest and moving[now.sequence][before.frame]:
            counts[now.camera] += 1
    return dict(counts)


def count_jumps(body: Body, joints: Mapping[str, JointTrajectories]) -> dict[str, list[int]]:
    """Return the frames of each sequence in which a body is where it cannot have come from."""
    jumps = {
        name: find_jumps(trajectories.transforms, body.joints[0], trajectories.fps)
        for name, trajectories in joints.items()
    }
    return {name: frames for name, frames in jumps.items() if frames}


def histogram(values: Float[Tensor, " n"]) -> dict[str, int]:
    """Return counts of values between fixed edges."""
    counts = np.histogram(values.numpy(), [*_EDGES, np.inf])[0].tolist()
    names = [f"{low:g}-{high:g}" for low, high in itertools.pairwise(_EDGES)]
    return dict(zip([*names, f">{_EDGES[-1]:g}"], counts, strict=True))


def _cover(alpha: UInt8[np.ndarray, "h w"]) -> tuple[float, float, bool]:
    """Return the shares of a mask and of its border that are covered, and whether all but a rim is."""
    border = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    y, x = (int(_RIM * size) for size in alpha.shape)
    full = bool((alpha[y : alpha.shape[0] - y, x : alpha.shape[1] - x] > 127).all())
    return float((alpha > 127).mean()), float((border > 127).mean()), full


def _describe(image: UInt8[np.ndarray, "h w 4"]) -> tuple[float, float]:
    """Return the person's mean linear luminance and mean distance between channels, from some pixels."""
    sampled = image[::_SKIPPED, ::_SKIPPED]
    person = sampled[sampled[..., 3] > 127][:, :3]
    if not len(person):
        return 0.0, 0.0
    luminance = linear_from_srgb(person / 255) @ _LUMINANCE
    return float(luminance.mean()), float(np.ptp(person, axis=1).mean())
