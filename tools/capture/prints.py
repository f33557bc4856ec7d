"""Pictures on cloth: a watercolour print for the skirt, stripes for the shirt. Colours are linear albedo."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray


def linear(*srgb: int) -> Float[ndarray, "3"]:
    """Return the linear value of an 8-bit sRGB colour."""
    value = np.array(srgb) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


GROUND = linear(112, 150, 148)
GROUND_DEEP = linear(70, 112, 122)
BLOOMS = [
    linear(*c)
    for c in ((226, 108, 92), (240, 226, 206), (176, 60, 104), (232, 172, 78), (214, 140, 160), (92, 84, 140))
]
LEAVES = [linear(*c) for c in ((52, 88, 70), (128, 148, 84))]
HEM, HEM_LINE = linear(34, 44, 78), linear(236, 226, 204)
CREAM, NAVY = linear(236, 228, 210), linear(40, 54, 96)


def noise(points: Float[ndarray, "n d"], scale: float, rng: np.random.Generator) -> Float[ndarray, " n"]:
    """Return smooth noise of unit variance: random plane waves of wavelengths about `scale` metres."""
    dimension = points.shape[1]
    direction = rng.normal(size=(24, dimension))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    wave = direction * (2 * np.pi / scale) * rng.uniform(0.6, 1.5, (24, 1))
    return np.cos(points @ wave.T + rng.uniform(0, 2 * np.pi, 24)).sum(1) / np.sqrt(12)


def paint_skirt(
    radius: Float[ndarray, " n"], angle: Float[ndarray, " n"], turn: float, seed: int
) -> Float[ndarray, "n 3"]:
    """Return the print at points of the flat cut.

    Args:
        radius: Distance from the cut's centre, metres, waist to hem.
        angle: Angle in the cut, 0..turn; the two ends meet at the seam.
        turn: Angle of the whole cut.
        seed: Of the flowers.
    """
    rng = np.random.default_rng(seed)
    phase = 2 * np.pi * angle / turn
    seamless = np.stack([np.cos(phase), np.sin(phase), radius / 0.35], -1) * 0.35
    wash = 0.5 + 0.30 * noise(seamless, 0.35, rng) + 0.12 * noise(seamless, 0.08, rng)
    color = GROUND + np.clip(wash, 0, 1)[:, None] * (GROUND_DEEP - GROUND)
    inner, outer = radius.min(), radius.max()
    for size, count in ((0.085, 13), (0.05, 24), (0.028, 46)):
        for index in range(count):
            depth = np.sqrt(rng.uniform((inner + 0.03) ** 2, (outer - 0.03) ** 2))
            around = turn * (index + rng.uniform(0, 0.9)) / count
            across = (np.remainder(angle - around + turn / 2, turn) - turn / 2) * 0.5 * (depth + radius)
            place = np.stack([across, radius - depth], -1)
            _paint_leaf(color, place, size * rng.uniform(0.9, 1.4), rng)
            _paint_bloom(color, place, size * rng.uniform(0.75, 1.25), rng)
    band = np.clip((radius - (outer - 0.042)) / 0.002, 0, 1)[:, None]
    line = (np.abs(radius - (outer - 0.056)) < 0.005)[:, None]
    color = np.where(line, HEM_LINE, color)
    return color + band * (HEM - color)


def _paint_bloom(
    color: Float[ndarray, "n 3"], place: Float[ndarray, "n 2"], size: float, rng: np.random.Generator
) -> None:
    """Blend one flower over the colours, in place: petals with a dark wet edge and a bright heart."""
    petals, tilt = int(rng.integers(4, 8)), rng.uniform(0, 2 * np.pi)
    tint = BLOOMS[int(rng.integers(len(BLOOMS)))]
    near = np.flatnonzero((np.abs(place) < 1.3 * size).all(1))
    distance = np.hypot(*place[near].T)
    bearing = np.arctan2(place[near, 1], place[near, 0]) + tilt
    edge = size * (0.72 + 0.28 * np.abs(np.cos(0.5 * petals * bearing)) + 0.05 * np.sin(3 * bearing + tilt))
    inside = np.clip((edge - distance) / 0.003, 0, 1)
    wet = np.exp(-(((edge - distance) / (0.09 * size)) ** 2))
    vein = 0.5 + 0.5 * np.cos(petals * bearing)
    shade = (1.0 - 0.45 * wet) * (0.72 + 0.28 * vein) * (1.15 - 0.3 * distance / size)
    alpha = (inside * (0.82 + 0.13 * vein))[:, None]
    color[near] += alpha * (np.clip(tint * shade[:, None], 0, 0.9) - color[near])
    heart = (np.clip((0.22 * size - distance) / 0.003, 0, 1))[:, None]
    color[near] += heart * (BLOOMS[3] * 0.9 - color[near])


def _paint_leaf(
    color: Float[ndarray, "n 3"], place: Float[ndarray, "n 2"], size: float, rng: np.random.Generator
) -> None:
    """Blend two leaves that look out from under a flower, in place."""
    for _ in range(2):
        bearing, tint = rng.uniform(0, 2 * np.pi), LEAVES[int(rng.integers(2))]
        along = place @ np.array([np.cos(bearing), np.sin(bearing)]) - size
        across = place @ np.array([-np.sin(bearing), np.cos(bearing)])
        form = 1 - (along / (0.62 * size)) ** 2 - (across / (0.24 * size)) ** 2
        alpha = 0.85 * np.clip(form * 6, 0, 1)[:, None]
        color += alpha * (tint * (0.8 + 0.4 * (across > 0))[:, None] - color)


def paint_shirt(points: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """Return the striped jersey at rest points of the body (metres): seams where the sleeves are set in."""
    along = np.where(np.abs(points[:, 0]) > 0.172, np.abs(points[:, 0]) + 0.012, points[:, 1])
    depth = np.abs(np.remainder(along / 0.052, 1.0) - 0.5) * 0.052
    yoke = (points[:, 1] > 0.50) & (np.abs(points[:, 0]) < 0.172)
    # A ramp as wide as the painted triangles keeps the stripes' edges straight.
    stripe = np.where(yoke, 0.0, np.clip((0.0125 - depth) / 0.009 + 0.5, 0, 1))
    return CREAM + stripe[:, None] * (NAVY - CREAM)
