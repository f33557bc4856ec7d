"""Levels of detail: all Gaussians, half and a quarter of them, under the same ids."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from dsar_exporters.usd.particle_frame import ParticleFrame


@dataclass(frozen=True)
class Level:
    """A level of detail: some of the Gaussians, enlarged to cover for the others."""

    name: str
    ids: Int64[np.ndarray, " m"]
    """Indices into the full set: the ids that every level shares."""
    enlargement: float
    """Factor on standard deviations, which keeps the area that is covered."""

    def select(self, frame: ParticleFrame) -> ParticleFrame:
        """Return this level's share of a frame."""
        if len(self.ids) == len(frame.means):
            return frame
        selected = {name: values.take(self.ids, 0) for name, values in vars(frame).items()}
        enlargement = np.float32(self.enlargement)
        return ParticleFrame(
            **{
                **selected,
                "scales": selected["scales"] * enlargement,
                "extents": selected["extents"] * enlargement,
            }
        )


def make_levels(points: Float32[np.ndarray, "n 3"]) -> list[Level]:
    """Return the levels full, half and quarter of Gaussians that lie at these points at rest.

    The points are put in the order of a space-filling curve, of which every second or fourth is kept: thinned
    evenly, and the quarter is part of the half.
    """
    order = _morton_order(points)
    return [
        Level("full", np.arange(len(points)), 1.0),
        Level("half", np.sort(order[::2]), 2**0.5),
        Level("quarter", np.sort(order[::4]), 2.0),
    ]


def _morton_order(points: Float32[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """Return points' indices in the order of a Morton curve."""
    if not len(points):
        return np.zeros(0, np.int64)
    span = max(float(np.ptp(points, axis=0).max()), 1e-9)
    cells = ((points - points.min(0)) / span * 1023).astype(np.uint64)
    codes = np.zeros(len(points), np.uint64)
    for bit in range(10):
        for axis in range(3):
            codes |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(codes, kind="stable")
