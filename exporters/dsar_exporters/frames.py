"""Frame ranges as film pipelines write them."""

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
