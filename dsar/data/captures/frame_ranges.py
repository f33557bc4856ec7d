"""Ranges of frames as the command line gives them."""

from dsar.errors import ConfigError


def parse_frame_range(text: str | None, count: int) -> range:
    """Return the frames of `count` that a range such as 0-239, or one number, names; all without one.

    Raises:
        ConfigError: the text is no such range.
    """
    if text is None:
        return range(count)
    first, _, last = text.partition("-")
    if not (first.isdigit() and (last or first).isdigit()):
        raise ConfigError(f"frame range {text!r} is not of the form 0-239")
    return range(min(int(first), count), min(int(last or first) + 1, count))
