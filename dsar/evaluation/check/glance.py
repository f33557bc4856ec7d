"""What some images of a capture show at once, before training spends hours on them."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from dsar.data.multiview import MultiViewCapture
from dsar.errors import CaptureError
from dsar.evaluation.check.content import Place, read_pictures
from dsar.evaluation.check.pictures import judge_colors, judge_masks

T = TypeVar("T")
_FRAMES, _CAMERAS = 5, 12
"""Frames and cameras that are looked at, at most."""


def refuse_at_a_glance(capture: MultiViewCapture) -> None:
    """Look at some training images and refuse what `dsar check` says cannot train: masks and photographs.

    Raises:
        CaptureError: an image cannot be used, or masks or photographs are not what they should be, in the
            words of `dsar check`.
    """
    pictures = list(read_pictures(capture, _some_places(capture)))
    broken = next((picture.broken for picture in pictures if picture.broken is not None), None)
    if broken is not None:
        raise CaptureError(broken)
    usable = {(p.sequence, p.frame, p.camera) for p in pictures if p.coverage > 0 and not p.full}
    findings = [*judge_masks(capture, pictures), *judge_colors(capture, pictures, usable)]
    fatal = next((finding for finding in findings if finding.fatal), None)
    if fatal is not None:
        raise CaptureError(
            f"capture {capture.name} cannot train: {fatal.name}: {fatal.what} (of {len(pictures)} images "
            "that were looked at; `dsar check` looks at all)"
        )


def _some_places(capture: MultiViewCapture) -> list[Place]:
    """Return sequence, frame and camera of images spread over the training frames and the cameras."""
    frames = [
        (name, frame) for name in capture.splits["train"] for frame in range(len(capture.motions[name]))
    ]
    cameras = _spread(range(len(capture.cameras)), _CAMERAS)
    places: list[Place] = []
    for camera in cameras:
        seen = [(name, frame) for name, frame in frames if camera in capture.seen_by(name, frame)]
        places += [(name, frame, camera) for name, frame in _spread(seen, _FRAMES)]
    return places


def _spread(items: Sequence[T], count: int) -> list[T]:
    """Return some of the items, the first and the last among them."""
    places = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[place] for place in places]
