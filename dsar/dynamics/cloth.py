"""A tube of cloth as distance constraints between the points of a coarse grid, and its constants."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32
from numpy import ndarray


@dataclass(frozen=True)
class ClothConstants:
    """What kind of cloth it is; compliances are of unit mass (Macklin et al. 2019)."""

    drag: float = 1.3
    """Quadratic air drag along the normal, 1/m."""
    damping: float = 0.4
    """Linear damping of the velocity, 1/s."""
    viscosity: float = 15.0
    """Rate at which a point takes its neighbours' mean velocity, 1/s."""
    friction: float = 0.7
    """Coulomb coefficient against the body."""
    thickness: float = 0.006
    """Distance kept from the body, metres."""
    pull: float = 5.5
    """Stiffness of the way home, 1/s²."""
    homing: float = 0.3
    """Damping of the velocity relative to home, 1/s."""
    core: float = 0.65
    """Share of its home's distance from the middle of its row within which no point comes."""
    slack: float = 1.04
    """How much wider than at rest the hem is once its folds are stretched out."""
    give: float = 1.025
    """The same for the diagonals, which carry the waist's turning to the hem."""
    shear: float = 6e-6
    """Compliance of the grid's diagonals."""
    bend: float = 7e-4
    """Compliance of the two-apart struts that resist bending."""
    fold: float = 8.5e-3
    """Compliance of the struts a sixth of the way around that keep folds few and large."""

    @classmethod
    def from_vector(cls, values: Float32[ndarray, " k"]) -> "ClothConstants":
        """Return the constants in the order of their fields."""
        return cls(*(float(value) for value in values))

    def to_vector(self) -> Float32[ndarray, " k"]:
        """Return the constants in the order of their fields."""
        return np.array(dataclasses.astuple(self), np.float32)

    @property
    def of_motion(self) -> Float32[ndarray, "8"]:
        """The constants that the solver takes besides those of its constraints."""
        return self.to_vector()[:8]


THREAD = 1e-7
"""Compliance of threads, down and around."""


@dataclass(frozen=True)
class Constraints:
    """Distances that the solver keeps, in the order in which it sweeps them."""

    ends: Int32[ndarray, "m 2"]
    """Indices of points, row by row from the top."""
    lengths: Float32[ndarray, " m"]
    """Metres."""
    compliances: Float32[ndarray, " m"]
    sides: Float32[ndarray, " m"]
    """1: resists only being stretched, as cloth in folds does; -1: only being pressed; 0: both."""


def build_constraints(rest: Float32[ndarray, "r c 3"], constants: ClothConstants) -> Constraints:
    """Return the constraints of a tube whose resting points are given, metres; columns close around.

    Cloth that hangs in folds widens freely, the more the nearer to the hem, until the folds are gone.
    """
    rows, columns = rest.shape[:2]
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    width = np.linalg.norm(rest - np.roll(rest, -1, 1), axis=-1)
    hem = np.arange(rows) / max(rows - 1, 1)
    slack, give, none = 1 + (constants.slack - 1) * hem, 1 + (constants.give - 1) * hem, np.ones(rows)
    kinds = (
        (1, 0, THREAD, 0, none),
        (0, 1, THREAD, 1, slack),
        (1, 1, constants.shear, 1, give),
        (1, -1, constants.shear, 1, give),
        (0, 2, constants.bend, -1, none),
        (2, 0, constants.bend, 0, none),
        (0, max(3, round(columns / 6)), constants.fold, -1, none),
    )
    ends, lengths, compliances, sides = [], [], [], []
    for down, along, compliance, side, wider in kinds:
        # The first row is fixed: nothing within it can give.
        inside = (row + down < rows) & ((row > 0) | (down > 0))
        r0, c0 = row[inside], column[inside]
        r1, c1 = r0 + down, (c0 + along) % columns
        length = np.linalg.norm(rest[r0, c0] - rest[r1, c1], axis=-1)
        lengths.append(np.sqrt(length**2 + (wider[r1] ** 2 - 1) * width[r1, c1] ** 2))
        ends.append(np.stack([r0 * columns + c0, r1 * columns + c1], -1))
        compliances.append(np.full(len(r0), compliance))
        sides.append(np.full(len(r0), side))
    return Constraints(
        np.concatenate(ends).astype(np.int32),
        np.concatenate(lengths).astype(np.float32),
        np.concatenate(compliances).astype(np.float32),
        np.concatenate(sides).astype(np.float32),
    )
