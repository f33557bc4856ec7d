"""Which frames of filmed takes train and which test."""

import logging
from collections.abc import Mapping

from dsar.errors import CaptureError
from dsar.geometry.frame_numbers import parse_frame_range

GAP = 40
"""Frames of a take that are left out between training and test: as many as any of our networks remembers
(the paper's longest window and memory), so that all are tested on the same ones."""
LOGGER = logging.getLogger(__name__)


def split_takes(
    where: str, lengths: Mapping[str, int], train: str | None, test: str | None
) -> dict[str, dict[str, tuple[str, range]]]:
    """Return for `train` and `test` the sequences by name: each one's take and its frames there.

    A single take is cut in two; of several the last third is held out.

    Args:
        where: What to name in errors.
        lengths: Frames of each take, by name, in order.
        train: Frames that train, such as 0-239: of a single take, or of each training take; None: all.
        test: Frames that test, likewise.

    Raises:
        CaptureError: no frames are left to train with, or to test.
        ConfigError: a range is not of the form 0-239.
    """
    takes = list(lengths)
    if len(takes) == 1:
        (take,) = takes
        ranges = zip(("train", "test"), split_take(lengths[take], train, test), strict=True)
        sequences = {split: {f"{take}_{split}": (take, frames)} for split, frames in ranges}
    else:
        held_out = max(1, len(takes) // 3)
        sequences = {
            split: {take: (take, parse_frame_range(text, lengths[take])) for take in members}
            for split, members, text in (
                ("train", takes[:-held_out], train),
                ("test", takes[-held_out:], test),
            )
        }
    sequences = {
        split: {name: (take, frames) for name, (take, frames) in members.items() if len(frames)}
        for split, members in sequences.items()
    }
    for split, members in sequences.items():
        if not members:
            raise CaptureError(
                f"{where}: no frames are left to {split} with; its takes have "
                f"{', '.join(map(str, lengths.values()))} frames, and a single one is cut with a gap of "
                f"{GAP}; say which with --train-frames and --test-frames"
            )
    return sequences


def split_take(count: int, train: str | None, test: str | None) -> tuple[range, range]:
    """Return which frames of a take train and which test: two thirds, a gap, and the rest by default."""
    two_thirds = count - count // 3
    training = parse_frame_range(train, count) if train else range(two_thirds)
    testing = parse_frame_range(test, count) if test else range(max(two_thirds, training.stop) + GAP, count)
    if training.start < testing.stop and testing.start < training.stop + GAP:
        LOGGER.warning(
            "Frames %d-%d train and %d-%d test: a memory reaches from one to the other (gap of %d asked)",
            *(training.start, training.stop - 1, testing.start, testing.stop - 1, GAP),
        )
    return training, testing
