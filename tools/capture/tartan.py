"""The second subject's print: a large check of muted wool colours with a border at the hem."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from capture.prints import linear, noise

GROUND, CHECK = linear(112, 52, 46), linear(46, 66, 62)
STRIPE, LINE = linear(196, 164, 104), linear(222, 212, 190)
BORDER = linear(38, 40, 52)
AROUND, DOWN = 9, 0.16
"""Checks around the skirt, and metres of one check down it."""


def paint_tartan(
    radius: Float[ndarray, " n"], angle: Float[ndarray, " n"], turn: float, seed: int
) -> Float[ndarray, "n 3"]:
    """Return the check at points of the flat cut.

    Threads run along the cut's rays and arcs, so that checks grow towards the hem as gores do. One ray in
    three is light instead of ochre, which tells how far the skirt is turned.

    Args:
        radius: Distance from the cut's centre, metres, waist to hem.
        angle: Angle in the cut, 0..turn; the two ends meet at the seam.
        turn: Angle of the whole cut.
        seed: Of the wool's mottling.
    """
    rng = np.random.default_rng(seed)
    below = radius.max() - radius
    warp, weft = AROUND * angle / turn, (below - 0.09) / DOWN
    check = 0.5 * _stripe(warp, 0.5, 0.25) + 0.5 * _stripe(weft, 0.5, 0.25)
    color = _cross(np.broadcast_to(GROUND, (len(radius), 3)), CHECK, check)
    light = np.floor(warp + 0.5).astype(int) % 3 == 0
    color = _cross(color, np.where(light[:, None], LINE, STRIPE), 0.8 * _stripe(warp, 0.0, 0.06))
    color = _cross(color, LINE, 0.8 * _stripe(weft, 0.0, 0.05))
    phase = 2 * np.pi * angle / turn
    seamless = np.stack([np.cos(phase), np.sin(phase), radius / 0.35], -1) * 0.35
    color = color * np.clip(1 + 0.06 * noise(seamless, 0.15, rng), 0.7, 1.3)[:, None]
    color = _cross(color, STRIPE, np.clip((0.007 - np.abs(below - 0.078)) / 0.003, 0, 1))
    return _cross(color, BORDER, np.clip((0.070 - below) / 0.003, 0, 1))


def _stripe(place: Float[ndarray, " n"], centre: float, half: float) -> Float[ndarray, " n"]:
    """Return 1 within a stripe of every unit of `place`, with soft edges."""
    distance = np.abs(np.remainder(place - centre + 0.5, 1.0) - 0.5)
    return np.clip((half - distance) / 0.03 + 0.5, 0, 1)


def _cross(
    color: Float[ndarray, "n 3"], tint: Float[ndarray, "*n 3"], share: Float[ndarray, " n"]
) -> Float[ndarray, "n 3"]:
    """Return the colour with a share of threads in another one."""
    return color + share[:, None] * (tint - color)
