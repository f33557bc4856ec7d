"""The solver in plain NumPy and double precision, to be read as the method: the slow twin of `solver`.

Extended position-based dynamics in small steps, each with one Gauss-Seidel sweep (Macklin et al. 2019):
forces change velocities, velocities move points, constraints move them back, and velocities are what is left.

World: metres, seconds, Y up.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int32
from numpy import ndarray

from dsar.dynamics.cloth import ClothConstants, Constraints
from dsar.dynamics.solver import CONTACT, FARTHEST, FASTEST, GRAVITY


class Surroundings(NamedTuple):
    """What is around the cloth at one moment."""

    home: Float64[ndarray, "n 3"]
    """Where skinning carries the resting garment, metres."""
    body: Float64[ndarray, "b 3"]
    """Points of the body's skin, metres."""
    normals: Float64[ndarray, "b 3"]
    """Their outward normals."""

    def towards(self, later: "Surroundings", fraction: float) -> "Surroundings":
        """Return the surroundings at a fraction of the way to later ones."""
        return Surroundings(
            *(a + fraction * (b - a) for a, b in zip(self, later, strict=True)),
        )


@dataclass
class ReferenceCloth:
    """A tube of cloth and its state: n = rows x columns points, row by row; the first row is held."""

    constants: ClothConstants
    constraints: Constraints
    neighbours: Int32[ndarray, "b k"]
    """Body points around each."""
    shape: tuple[int, int]
    """Rows and columns."""
    points: Float64[ndarray, "n 3"]
    """Metres."""
    velocities: Float64[ndarray, "n 3"]
    """Metres per second."""
    nearest: Int32[ndarray, " n"]
    """Body point nearest to each."""

    def simulate(
        self, moments: Sequence[Surroundings], steps: int, fps: float
    ) -> Float64[ndarray, "frames n 3"]:
        """Go through all frames but the first, in so many steps each; return the points, metres."""
        frames = []
        for before, after in pairwise(moments):
            for step in range(steps):
                self._step(before, after, step, steps, 1 / (fps * steps))
            frames.append(self.points.copy())
        return np.array(frames)

    def _step(self, before: Surroundings, after: Surroundings, step: int, steps: int, dt: float) -> None:
        now = before.towards(after, (step + 1) / steps)
        # What the surroundings do in this step.
        home_step, body_step = ((b - a) / steps for a, b in zip(before[:2], after[:2], strict=True))
        self._accelerate(now.home, home_step / dt, dt)
        previous = self.points.copy()
        self.points[self._free] += dt * self.velocities[self._free]
        self.points[self._held] = now.home[self._held]
        self._sweep(dt, backwards=step % 2 == 1)
        self._find_nearest(now.body)
        self._collide(now, previous, body_step)
        self._stay_open(now.home)
        self._limit(now.home)
        self.velocities = _shortened((self.points - previous) / dt, float(FASTEST))

    @property
    def _held(self) -> slice:
        return slice(0, self.shape[1])

    @property
    def _free(self) -> slice:
        return slice(self.shape[1], None)

    def _accelerate(
        self, home: Float64[ndarray, "n 3"], home_velocities: Float64[ndarray, "n 3"], dt: float
    ) -> None:
        """Apply all forces but those of constraints; resistances implicitly, so that none overshoots."""
        cloth, old = self.constants, self.velocities
        normals, mean = self._normals(), self._neighbours_mean(old)
        across = (old * normals).sum(1, keepdims=True)
        air = across / (1 + dt * cloth.drag * abs(across)) - across
        new = old + normals * air + min(dt * cloth.viscosity, 0.5) * (mean - old)
        new += dt * (cloth.pull * (home - self.points) + cloth.homing * home_velocities)
        new += dt * np.array([0, -float(GRAVITY), 0])
        new /= 1 + dt * (cloth.damping + cloth.homing)
        self.velocities = np.concatenate([old[self._held], new[self._free]])

    def _beside(self, values: Float64[ndarray, "n 3"]) -> list[Float64[ndarray, "n 3"]]:
        """Return the values of the points above, below, left and right of each; the hem is below itself."""
        grid = values.reshape(*self.shape, 3)
        above, below = np.concatenate([grid[:1], grid[:-1]]), np.concatenate([grid[1:], grid[-1:]])
        sides = (above, below, np.roll(grid, 1, 1), np.roll(grid, -1, 1))
        return [side.reshape(-1, 3) for side in sides]

    def _normals(self) -> Float64[ndarray, "n 3"]:
        above, below, left, right = self._beside(self.points)
        return _unit(np.cross(below - above, right - left))

    def _neighbours_mean(self, values: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
        return np.mean(self._beside(values), axis=0)

    def _sweep(self, dt: float, *, backwards: bool) -> None:
        """Project each constraint C = |x_i - x_j| - l once: the multiplier is -C / (w_i + w_j + a / dt^2)."""
        order = range(len(self.constraints.ends))
        for c in reversed(order) if backwards else order:
            i, j = self.constraints.ends[c]
            way = self.points[i] - self.points[j]
            distance = np.sqrt((way**2).sum())
            excess = distance - float(self.constraints.lengths[c])
            if self.constraints.sides[c] * excess < 0:
                continue
            # Inverse masses: points that are held do not give way.
            w_i, w_j = float(i >= self.shape[1]), float(j >= self.shape[1])
            multiplier = -excess / (w_i + w_j + float(self.constraints.compliances[c]) / dt**2)
            self.points[i] += w_i * multiplier * way / distance
            self.points[j] -= w_j * multiplier * way / distance

    def _find_nearest(self, body: Float64[ndarray, "b 3"]) -> None:
        """Walk from each point's last nearest body point downhill to a nearest one."""
        points, nearest = self.points[self._free], self.nearest[self._free]
        while True:
            candidates = np.concatenate([nearest[:, None], self.neighbours[nearest]], 1)
            distances = ((points[:, None] - body[candidates]) ** 2).sum(-1)
            nearer = candidates[np.arange(len(points)), distances.argmin(1)]
            if (nearer == nearest).all():
                break
            nearest = nearer
        self.nearest[self._free] = nearest

    def _collide(
        self,
        now: Surroundings,
        previous: Float64[ndarray, "n 3"],
        body_step: Float64[ndarray, "b 3"],
    ) -> None:
        """Push points out of the tangent plane of their nearest body point, and let them rub against it."""
        j = self.nearest[self._free]
        points, normals = self.points[self._free], _unit(now.normals[j])
        way = points - now.body[j]
        depth = self.constants.thickness - (way * normals).sum(1)
        touches = (np.linalg.norm(way, axis=1) <= CONTACT) & (depth > 0)
        points = points + depth[:, None] * normals
        slip = points - previous[self._free] - body_step[j]
        slip -= (slip * normals).sum(1, keepdims=True) * normals
        # Coulomb: what friction takes from a slip is no more than its share of the push.
        size = np.linalg.norm(slip, axis=1).clip(1e-12)
        points -= np.minimum(1, self.constants.friction * depth / size)[:, None] * slip
        self.points[self._free] = np.where(touches[:, None], points, self.points[self._free])

    def _stay_open(self, home: Float64[ndarray, "n 3"]) -> None:
        """Keep points away from the line through the rows' middles."""
        grid, points = home.reshape(*self.shape, 3), self.points.reshape(*self.shape, 3)
        centers = grid.mean(1)
        for row in range(1, self.shape[0]):
            axis = _unit(centers[min(row + 1, self.shape[0] - 1)] - centers[row - 1])
            outwards, home_outwards = (
                x - (x @ axis)[:, None] * axis for x in (points[row] - centers[row], grid[row] - centers[row])
            )
            least = self.constants.core * np.linalg.norm(home_outwards, axis=1)
            distance = np.linalg.norm(outwards, axis=1).clip(1e-12)
            points[row] += outwards * (least / distance - 1).clip(0)[:, None]

    def _limit(self, home: Float64[ndarray, "n 3"]) -> None:
        """Keep every point within reach of its home."""
        self.points = home + _shortened(self.points - home, float(FARTHEST))


def _unit(vectors: Float64[ndarray, "*n 3"]) -> Float64[ndarray, "*n 3"]:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True).clip(1e-12)


def _shortened(vectors: Float64[ndarray, "n 3"], limit: float) -> Float64[ndarray, "n 3"]:
    """Return vectors none of which is longer than a limit."""
    return vectors * (limit / np.linalg.norm(vectors, axis=1, keepdims=True).clip(limit))
