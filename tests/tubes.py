"""A small tube of cloth on a made body, moved by given moments, and both solvers that move it."""

import dataclasses

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from dsar.dynamics import solver
from dsar.dynamics.cloth import ClothConstants, Constraints, build_constraints
from dsar.dynamics.reference import ReferenceCloth, Surroundings

ROWS, COLUMNS = 5, 8
FPS, STEPS = 30.0, 5
FREE = ClothConstants(
    drag=0.0, damping=0.0, viscosity=0.0, friction=0.0, thickness=0.006, pull=0.0, homing=0.0, core=0.0,
    slack=1.0, give=1.0, shear=0.0, bend=0.0, fold=0.0,
)  # fmt: skip
"""Cloth on which nothing but gravity and its constraints acts."""


def links(
    ends: list[tuple[int, int]], lengths: list[float], compliance: float = 0.0, side: float = 0.0
) -> Constraints:
    """Return distance constraints of one kind; none where there are no ends."""
    count = len(ends)
    return Constraints(
        np.array(ends, np.int32).reshape(count, 2),
        np.array(lengths, np.float32),
        np.full(count, compliance, np.float32),
        np.full(count, side, np.float32),
    )


def tube(rows: int = ROWS, columns: int = COLUMNS) -> Float32[ndarray, "r c 3"]:
    """Return a resting skirt with shallow folds, hem half a metre below the waist, metres."""
    around = np.arange(columns) / columns * 2 * np.pi
    down = np.linspace(0, 1, rows)[:, None]
    radius = 0.2 + down * (0.15 + 0.02 * np.cos(3 * around))
    height = 1 - 0.5 * down + 0 * around
    return np.stack([radius * np.sin(around), height, radius * np.cos(around)], -1).astype(np.float32)


def column_of_body(rings: int = 16, columns: int = 16) -> tuple[ndarray, ndarray, ndarray]:
    """Return an upright cylinder as points of skin [b, 3], their normals, and the 8 points around each."""
    around = np.arange(columns) / columns * 2 * np.pi
    height = np.linspace(0.3, 1.1, rings)[:, None]
    out = np.stack([np.sin(around), 0 * around, np.cos(around)], -1)
    points = (0.19 * out[None] + height[:, :, None] * np.array([0, 1, 0])).reshape(-1, 3)
    normals = np.broadcast_to(out, (rings, columns, 3)).reshape(-1, 3)
    distances = np.linalg.norm(points[:, None] - points, axis=-1)
    neighbours = distances.argsort(1, kind="stable")[:, 1:9]
    return points.astype(np.float32), normals.astype(np.float32), neighbours.astype(np.int32)


def far_body() -> tuple[ndarray, ndarray, ndarray]:
    """Return a body that touches nothing: one point a kilometre below."""
    point = np.array([[0, -1000, 0]], np.float32)
    return point, np.array([[0, 1, 0]], np.float32), np.zeros((1, 1), np.int32)


@dataclasses.dataclass
class Cloth:
    """Cloth in single precision, as the compiled solver moves it."""

    constants: ClothConstants
    constraints: Constraints
    shape: tuple[int, int]
    points: Float32[ndarray, "n 3"]
    velocities: Float32[ndarray, "n 3"]
    nearest: ndarray
    neighbours: ndarray

    @classmethod
    def at_rest(
        cls,
        constants: ClothConstants,
        body: tuple[ndarray, ndarray, ndarray],
        rest: Float32[ndarray, "r c 3"] | None = None,
        constraints: Constraints | None = None,
    ) -> "Cloth":
        """Return cloth in its rest shape, around a body's points."""
        rest = tube() if rest is None else rest
        points = rest.reshape(-1, 3).copy()
        nearest = ((points[:, None] - body[0]) ** 2).sum(-1).argmin(1).astype(np.int32)
        constraints = build_constraints(rest, constants) if constraints is None else constraints
        return cls(constants, constraints, rest.shape[:2], points, np.zeros_like(points), nearest, body[2])

    def simulate(
        self, home: ndarray, body: ndarray, normals: ndarray, steps: int = STEPS, fps: float = FPS
    ) -> Float32[ndarray, "frames n 3"]:
        """Go through all frames but the first; return the points."""
        home, body, normals = (np.ascontiguousarray(x, np.float32) for x in (home, body, normals))
        found = np.empty((len(home) - 1, *self.points.shape), np.float32)
        kept = self.constraints
        solver.simulate(
            self.points, self.velocities, self.nearest, home, body, normals, self.neighbours,
            kept.ends, kept.lengths, kept.compliances, kept.sides, self.constants.of_motion, self.shape,
            steps, fps, found,
        )  # fmt: skip
        return found

    def twin(self) -> ReferenceCloth:
        """Return the slow twin in the same state."""
        return ReferenceCloth(
            # As the kernel has them, to single precision.
            ClothConstants.from_vector(self.constants.to_vector()),
            self.constraints, self.neighbours, self.shape,
            self.points.astype(np.float64), self.velocities.astype(np.float64), self.nearest.copy(),
        )  # fmt: skip


def moments(home: ndarray, body: ndarray, normals: ndarray) -> list[Surroundings]:
    """Return what is around the cloth by frame, as the slow twin takes it."""
    wide = (np.asarray(x, np.float32).astype(np.float64) for x in (home, body, normals))
    return [Surroundings(*frame) for frame in zip(*wide, strict=True)]


def still(home: ndarray, body: tuple[ndarray, ndarray, ndarray], frames: int) -> tuple[ndarray, ...]:
    """Return home, body and normals of a body that stands for so many frames."""
    flat = home.reshape(-1, 3)
    return tuple(np.repeat(array[None], frames, 0) for array in (flat, body[0], body[1]))


def turning(angle: float) -> ndarray:
    """Return the rotation about the vertical by an angle, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def moved(
    home: ndarray, body: tuple[ndarray, ndarray, ndarray], angles: ndarray, ways: ndarray
) -> tuple[ndarray, ndarray, ndarray]:
    """Return home, body and normals of a stiff body that turns and travels, by frame."""
    turns = np.stack([turning(angle) for angle in angles])
    ways = np.asarray(ways)[:, None]
    return (
        (home.reshape(1, -1, 3) @ turns.swapaxes(1, 2) + ways).astype(np.float32),
        (body[0][None] @ turns.swapaxes(1, 2) + ways).astype(np.float32),
        (body[1][None] @ turns.swapaxes(1, 2)).astype(np.float32),
    )
