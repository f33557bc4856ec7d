"""Frame rates that are written in different digits and mean the same."""

import math

_TOLERANCE = 2e-4
"""Relative: 29.97 is 30000/1001 and 23.98 is 23.976, but 23.976 is not 24 (a thousandth away)."""


def same_rate(first: float, second: float) -> bool:
    """Whether two rates mean the same: 29.97 is 30000/1001."""
    return math.isclose(first, second, rel_tol=_TOLERANCE)
