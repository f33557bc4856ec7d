"""What the numbers of a camera's masks mean: 0 and 255 are not the only way to say nobody and person."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from dsar.data.images.conversions import Note
from dsar.data.images.pixels import MaskLevels
from dsar.errors import CaptureError

_SAMPLES = 5
"""Masks of a camera that are looked at, at most."""
_USUAL, _FAINT = 0.9, 0.5
"""Shares of the highest number: masks reach the one, and those that do not reach the other are no masks."""

_DEEP = Note("have 16 bits, of which the upper 8 are taken")


@dataclass(frozen=True)
class MaskEncoding:
    """How one camera's masks are written."""

    person: int | None = None
    """The number that is wholly person, where the others are 0; None: the highest of the file's type."""
    notes: Sequence[Note] = ()
    """What to tell the user."""

    def decode(self, levels: MaskLevels, where: str) -> UInt8[np.ndarray, "h w"]:
        """Return coverage, 0 to 255.

        Raises:
            CaptureError: A number is higher than those of the camera's other masks.
        """
        values = levels.values
        if self.person is None:
            return values if values.dtype == np.uint8 else (values >> 8).astype(np.uint8)
        if values.max() > self.person:
            raise CaptureError(
                f"mask {where}: expected 0 and {self.person} as in this camera's other masks, found "
                f"{values.max()}; write all masks alike"
            )
        return (values.astype(np.uint32) * 255 // self.person).astype(np.uint8)


def sample_frames(frames: Sequence[int]) -> list[int]:
    """Return some of the frames in which a camera has a mask, of all of the take."""
    places = np.linspace(0, len(frames) - 1, min(_SAMPLES, len(frames))).round().astype(int)
    return [frames[place] for place in places]


def detect_mask_encoding(masks: Iterable[tuple[Callable[[], MaskLevels], str]]) -> MaskEncoding:
    """Return how one camera's masks are written, with what to say of how they were decoded.

    Args:
        masks: Decodes each, and where it lies. Those that cannot be decoded are passed over: they are named
            when they are read.

    Raises:
        CaptureError: None can be decoded, or they are no masks.
    """
    faults: list[CaptureError] = []
    sound: list[str] = []
    notes: dict[Note, None] = {}

    def readable() -> Iterator[tuple[MaskLevels, str]]:
        for decode, where in masks:
            try:
                levels = decode()
            except CaptureError as error:
                faults.append(error)
                continue
            sound.append(where)
            notes.update(dict.fromkeys(levels.notes))
            yield levels, where

    encoding = infer_mask_encoding(readable())
    if faults and not sound:
        raise faults[0]
    return MaskEncoding(encoding.person, (*notes, *encoding.notes))


def infer_mask_encoding(samples: Iterable[tuple[MaskLevels, str]]) -> MaskEncoding:
    """Return how masks are written, from some of one camera's and where each lies.

    Raises:
        CaptureError: They are no masks.
    """
    top, full, values, first = 0, 255, np.zeros(1, np.uint16), ""
    for levels, where in samples:
        highest, full = int(levels.values.max()), int(np.iinfo(levels.values.dtype).max)
        if highest > _USUAL * full:
            return MaskEncoding() if full == 255 else MaskEncoding(None, (_DEEP,))
        values = np.union1d(values, np.unique(levels.values))
        top, first = max(top, highest), first or where if highest else first
    if top == 0:
        return MaskEncoding()
    if len(values) == 2:
        return MaskEncoding(top, (Note(f"are of 0 and {top} alone: {top} is the person"),))
    if top == 255:
        return MaskEncoding(top, (Note("have 8 bits in numbers of 16: 255 is the person"),))
    if top < _FAINT * full:
        raise CaptureError(
            f"mask {first}: is no mask: expected {full} for the person and 0 elsewhere, found {len(values)} "
            f"numbers from 0 to {top} (parts of a person by number?); save it anew"
        )
    return MaskEncoding()
