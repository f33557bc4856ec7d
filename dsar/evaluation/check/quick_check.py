"""What some images of a capture show at once, before training spends hours on them."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from dsar.data.captures.multiview import MultiViewCapture
from dsar.errors import CaptureError
from dsar.evaluation.check.image_findings import find_color_faults, find_mask_faults
from dsar.evaluation.check.image_summaries import ImageIndex, summarize_images

T = TypeVar("T")
_FRAMES, _CAMERAS = 5, 12
"""Frames and cameras that are looked at, at most."""


def refuse_unusable_images(capture: MultiViewCapture) -> None:
    """Look at some training images and refuse what `dsar check` says cannot train: masks and photographs.

    Raises:
        CaptureError: an image cannot be used, or masks or photographs are not what they should be, in the
            words of `dsar check`.
    """
    summaries = list(summarize_images(capture, _sample_images(capture)))
    broken = next((summary.broken for summary in summaries if summary.broken is not None), None)
    if broken is not None:
        raise CaptureError(broken)
    usable = {(p.sequence, p.frame, p.camera) for p in summaries if p.coverage > 0 and not p.full}
    findings = [*find_mask_faults(capture, summaries), *find_color_faults(capture, summaries, usable)]
    fatal = next((finding for finding in findings if finding.fatal), None)
    if fatal is not None:
        raise CaptureError(
            f"capture {capture.name} cannot train: {fatal.name}: {fatal.what} (of {len(summaries)} images "
            "that were looked at; `dsar check` looks at all)"
        )


def _sample_images(capture: MultiViewCapture) -> list[ImageIndex]:
    """Return sequence, frame and camera of images spread over the training frames and the cameras."""
    frames = [
        (name, frame) for name in capture.splits["train"] for frame in range(len(capture.motions[name]))
    ]
    cameras = _spread(range(len(capture.cameras)), _CAMERAS)
    places: list[ImageIndex] = []
    for camera in cameras:
        seen = [(name, frame) for name, frame in frames if camera in capture.cameras_with_image(name, frame)]
        places += [(name, frame, camera) for name, frame in _spread(seen, _FRAMES)]
    return places


def _spread(items: Sequence[T], count: int) -> list[T]:
    """Return some of the items, the first and the last among them."""
    places = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[place] for place in places]
