"""The second subject's print: a large check of muted wool colours, cut on the bias of a flared skirt."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from capture.prints import linear, noise

GROUND, CHECK = linear(112, 52, 46), linear(46, 66, 62)
STRIPE, LINE = linear(196, 164, 104), linear(222, 212, 190)
BORDER, PIPING = linear(38, 40, 52), linear(196, 164, 104)
AROUND, DOWN = 12, 0.105
"""Checks around the skirt, and metres of one check down it."""


def paint_tartan(
    radius: Float[ndarray, " n"], angle: Float[ndarray, " n"], turn: float, seed: int
) -> Float[ndarray, "n 3"]:
    """Return the check at points of the flat cut.

    Threads run along the cut's rays and arcs, so that checks grow towards the hem as gores do. One check in
    three is told from the others by its own stripe: looks say which side of the skirt is in front.

    Args:
        radius: Distance from the cut's centre, metres, waist to hem.
        angle: Angle in the cut, 0..turn; the two ends meet at the seam.
        turn: Angle of the whole cut.
        seed: Of the wool's mottling.
    """
    rng = np.random.default_rng(seed)
    outer = radius.max()
    warp, weft = AROUND * angle / turn, (outer - radius) / DOWN
    color = GROUND + (0.5 * _band(warp, 0.5, 0.25) + 0.5 * _band(weft, 0.5, 0.25))[:, None] * (CHECK - GROUND)
    kind = np.floor(warp).astype(int) % 3
    for tint, place in ((STRIPE, 0.12), (LINE, 0.88)):
        color = _cross(color, tint, 0.75 * _band(warp, place, 0.055) * (kind != (place < 0.5)))
        color = _cross(color, tint, 0.75 * _band(weft, place, 0.055))
    phase = 2 * np.pi * angle / turn
    ring = np.stack([np.cos(phase), np.sin(phase), radius / 0.35], -1) * 0.35
    mottle = 1 + 0.05 * noise(ring, 0.12, rng) + 0.05 * noise(ring, 0.03, rng)
    color = color * np.clip(mottle, 0.7, 1.3)[:, None]
    color = _cross(color, PIPING, np.clip((0.007 - np.abs(outer - 0.078 - radius)) / 0.003, 0, 1))
    return _cross(color, BORDER, np.clip((radius - outer + 0.070) / 0.003, 0, 1))


def _band(place: Float[ndarray, " n"], centre: float, half: float) -> Float[ndarray, " n"]:
    """Return 1 within a stripe of every unit of `place`, with soft edges."""
    distance = np.abs(np.remainder(place - centre + 0.5, 1.0) - 0.5)
    return np.clip((half - distance) / 0.03 + 0.5, 0, 1)


def _cross(
    color: Float[ndarray, "n 3"], tint: Float[ndarray, "3"], share: Float[ndarray, " n"]
) -> Float[ndarray, "n 3"]:
    """Return the colour with a share of threads in another one."""
    return color + share[:, None] * (tint - color)
