"""Frames as people name them: numbers of a delivery as film pipelines write them, and stretches of a take."""

from fileseq.exceptions import FileSeqException
from fileseq.frameset import FrameSet

from dsar.errors import ConfigError


def parse_frames(text: str) -> list[int]:
    """Return the frame numbers of a range such as `1001-1100`, `1001-1100x2` or `1001-1010,1020`.

    Ascending and without duplicates whatever the order of the text, because a rollout only runs forward.
    The syntax is fileseq's (also `x`, `y` and `:` steps, and negative numbers).

    Raises:
        ConfigError: The text is no frame range, is empty, or names fractions of a frame.
    """
    try:
        frames = list(FrameSet(text))
    except (FileSeqException, ValueError) as error:
        raise ConfigError(
            f"frames: expected a range such as 1001-1100, 1001-1100x2 or 1001-1010,1020, found {text!r}"
        ) from error
    if not frames:
        raise ConfigError("frames: the range is empty; write for example 1001-1100")
    if any(frame != int(frame) for frame in frames):
        raise ConfigError(f"frames: expected whole frame numbers, found fractions in {text!r}")
    return sorted(int(frame) for frame in frames)


def parse_frame_range(text: str | None, count: int) -> range:
    """Return the frames of a take of `count` that a stretch such as 0-239, or one number, names; None: all.

    Raises:
        ConfigError: the text is no such stretch.
    """
    if text is None:
        return range(count)
    first, _, last = text.partition("-")
    if not (first.isdigit() and (last or first).isdigit()):
        raise ConfigError(f"frame range {text!r} is not of the form 0-239")
    return range(min(int(first), count), min(int(last or first) + 1, count))
