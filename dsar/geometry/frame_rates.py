"""Frame rates that are written in different digits and mean the same."""

import math
import re
from fractions import Fraction

from dsar.errors import ConfigError

_TOLERANCE = 2e-4
"""Relative: 29.97 is 30000/1001 and 23.98 is 23.976, but 23.976 is not 24 (a thousandth away)."""
_NTSC = Fraction(1000, 1001)
_SLOWEST, _FASTEST = 1, 1000
"""Frames per second that can be asked for."""
_RATE = re.compile(r"(\d{1,9}(?:\.\d{1,9})?)(?:\s*/\s*(\d{1,9}))?", re.ASCII)


def same_rate(first: float, second: float) -> bool:
    """Whether two rates mean the same: 29.97 is 30000/1001."""
    return math.isclose(first, second, rel_tol=_TOLERANCE)


def exact_rate(fps: float) -> Fraction:
    """Return the fraction that a rate stands for: 24, 24000/1001 for 23.976 and 23.98, 25/2 for 12.5."""
    whole = round(fps)
    for meant in (Fraction(whole), whole * _NTSC):
        if meant and same_rate(fps, float(meant)):
            return meant
    return Fraction(fps).limit_denominator(10**6)


def parse_rate(text: str, flag: str = "--fps") -> float:
    """Return a rate that people write: `24`, `23.976`, `29.97`, `24000/1001`; frames per second.

    Raises:
        ConfigError: It is no rate, or none from 1 to 1000.
    """
    rate, match = Fraction(0), _RATE.fullmatch(text.strip())
    if match and (divisor := int(match[2] or 1)):
        rate = Fraction(match[1]) / divisor
    if not _SLOWEST <= rate <= _FASTEST:
        raise ConfigError(
            f"{flag} {text}: expected frames per second from {_SLOWEST} to {_FASTEST}, such as 24, 23.976 or "
            "24000/1001"
        )
    return float(exact_rate(float(rate)))
