"""Extended position-based dynamics of a skirt on a moving body, seeded and bit-reproducible.

The skirt is a closed grid: `columns` around, `rows` down, row 0 at the waist. Small substeps with one
Gauss-Seidel sweep each (Macklin et al. 2019); the body collides as the tangent planes of its vertices.
World: metres, seconds, Y up.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

GRAVITY = 9.81


@dataclass(frozen=True)
class Fabric:
    """Mechanical constants of the cloth."""

    stretch: float = 1e-7
    """Compliance of threads, m/N per unit mass (XPBD alpha)."""
    shear: float = 2e-5
    """Compliance of the grid's diagonals."""
    bend: float = 1.2e-4
    """Compliance of the two-apart struts that resist bending."""
    fold: float = 5e-4
    """Compliance of the six-apart struts that keep folds few and large."""
    drag: float = 0.8
    """Quadratic air drag along the normal, 1/m (half air density over area density)."""
    damping: float = 0.7
    """Linear damping of velocity, 1/s."""
    viscosity: float = 0.14
    """Share of the difference to the neighbours' mean velocity removed a substep."""
    friction: float = 0.35
    """Coulomb coefficient against the body."""
    thickness: float = 0.009
    """Distance kept from the body, metres."""


@dataclass(frozen=True)
class Collider:
    """The body as the solver sees it: one set of vertices over time and their connectivity."""

    vertices: Float[ndarray, "f v 3"]
    normals: Float[ndarray, "f v 3"]
    neighbours: Int[ndarray, "v k"]
    """Indices of vertices joined by an edge, padded with the vertex itself."""


@dataclass(frozen=True)
class Strut:
    """Distance constraints of one kind: endpoints, rest lengths and compliance."""

    ends: Int[ndarray, "n 2"]
    lengths: Float[ndarray, " n"]
    compliance: float


def build_struts(pattern: Float[ndarray, "r c 2"], turn: float, fabric: Fabric) -> list[Strut]:
    """Return all constraints of a skirt whose flat pattern is part of an annulus.

    Args:
        pattern: Polar coordinates (radius in metres, angle in radians) of each vertex in the flat cut.
        turn: Angle of the whole cut; the seam joins angle `turn` to 0.
        fabric: Compliances.
    """
    rows, columns = pattern.shape[:2]
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    kinds = (
        ((0, 1), fabric.stretch), ((1, 0), fabric.stretch), ((1, 1), fabric.shear), ((1, -1), fabric.shear),
        ((0, 2), fabric.bend), ((2, 0), fabric.bend), ((0, 6), fabric.fold), ((4, 0), fabric.fold),
    )  # fmt: skip
    struts = []
    for (down, along), compliance in kinds:
        inside = row + down < rows
        r0, c0 = row[inside], column[inside]
        r1, c1 = r0 + down, c0 + along
        angle = pattern[r1, c1 % columns, 1] + turn * np.floor_divide(c1, columns) - pattern[r0, c0, 1]
        a, b = pattern[r0, c0, 0], pattern[r1, c1 % columns, 0]
        length = np.sqrt(a * a + b * b - 2 * a * b * np.cos(angle))
        ends = np.stack([r0 * columns + c0, r1 * columns + c1 % columns], -1)
        struts.append(Strut(ends.astype(np.int64), length, compliance))
    return struts


def simulate(
    start: Float[ndarray, "n 3"],
    anchors: Float[ndarray, "f p 3"],
    struts: list[Strut],
    shape: tuple[int, int],
    collider: Collider,
    fabric: Fabric,
    fps: float,
    wind: Float[ndarray, "f 3"],
    substeps: int = 20,
) -> Iterator[Float[ndarray, "n 3"]]:
    """Yield the cloth's vertices at every frame, the first being `start` itself.

    Args:
        start: Vertices at frame 0, row by row, at rest.
        anchors: Positions over time of the first p vertices, which follow the body.
        struts: Constraints, swept in order.
        shape: Rows and columns of the grid.
        collider: The body at the same frames.
        fabric: Constants.
        fps: Frames per second.
        wind: Air velocity per frame, m/s.
        substeps: Solver steps a frame.
    """
    ends = np.concatenate([s.ends for s in struts])
    lengths = np.concatenate([s.lengths for s in struts])
    compliance = np.concatenate([np.full(len(s.lengths), s.compliance) for s in struts])
    inverse_mass = np.ones(len(start))
    inverse_mass[: anchors.shape[1]] = 0.0
    constants = np.array([fabric.drag, fabric.damping, fabric.viscosity, fabric.friction, fabric.thickness])
    x, v = start.copy(), np.zeros_like(start)
    nearest = np.zeros(len(x), np.int64)
    yield x.copy()
    for frame in range(1, len(anchors)):
        _find_nearest(x, collider.vertices[frame - 1], nearest)
        _advance(
            x, v, nearest, inverse_mass, ends, lengths, compliance, constants, shape[0], shape[1],
            anchors[frame - 1], anchors[frame], collider.vertices[frame - 1], collider.vertices[frame],
            collider.normals[frame - 1], collider.normals[frame], collider.neighbours, wind[frame],
            1.0 / fps, substeps,
        )  # fmt: skip
        yield x.copy()


@numba.njit(cache=True)
def _find_nearest(x, body, nearest):
    """Write the index of the body vertex nearest to each cloth vertex."""
    for i in range(len(x)):
        best = 1e9
        for j in range(len(body)):
            dx, dy, dz = x[i, 0] - body[j, 0], x[i, 1] - body[j, 1], x[i, 2] - body[j, 2]
            squared = dx * dx + dy * dy + dz * dz
            if squared < best:
                best, nearest[i] = squared, j


@numba.njit(cache=True)
def _advance(
    x, v, nearest, inverse_mass, ends, lengths, compliance, constants, rows, columns,
    anchors0, anchors1, body0, body1, normals0, normals1, neighbours, wind, duration, substeps,
):  # fmt: skip
    """Advance positions and velocities by one frame, in place."""
    dt = duration / substeps
    drag, damping, viscosity, friction, thickness = constants
    previous = np.empty_like(x)
    for step in range(substeps):
        s0, s1 = step / substeps, (step + 1) / substeps
        _apply_air(x, v, inverse_mass, rows, columns, wind, drag, damping, dt)
        _smooth_velocity(v, inverse_mass, rows, columns, viscosity)
        for i in range(len(x)):
            for k in range(3):
                previous[i, k] = x[i, k]
                if inverse_mass[i] == 0.0:
                    x[i, k] = anchors0[i, k] + s1 * (anchors1[i, k] - anchors0[i, k])
                else:
                    x[i, k] += dt * v[i, k]
        _project_struts(x, inverse_mass, ends, lengths, compliance, dt, step % 2 == 1)
        _collide(
            x, previous, inverse_mass, nearest, neighbours,
            body0, body1, normals0, normals1, s0, s1, friction, thickness,
        )  # fmt: skip
        for i in range(len(x)):
            for k in range(3):
                v[i, k] = (x[i, k] - previous[i, k]) / dt


@numba.njit(cache=True)
def _apply_air(x, v, inverse_mass, rows, columns, wind, drag, damping, dt):
    """Add gravity and the air's resistance to velocities; the normal part is quadratic and implicit."""
    for i in range(len(x)):
        if inverse_mass[i] == 0.0:
            continue
        row, column = i // columns, i % columns
        up, down = max(row - 1, 0), min(row + 1, rows - 1)
        a = x[down * columns + column] - x[up * columns + column]
        b = x[row * columns + (column + 1) % columns] - x[row * columns + (column - 1) % columns]
        n = np.cross(a, b)
        n /= np.sqrt((n * n).sum()) + 1e-12
        relative = v[i] - wind
        along = (relative * n).sum()
        factor = 1.0 / (1.0 + dt * drag * abs(along))
        v[i] += n * along * (factor - 1.0) - dt * damping * relative
        v[i, 1] -= dt * GRAVITY


@numba.njit(cache=True)
def _smooth_velocity(v, inverse_mass, rows, columns, viscosity):
    """Draw velocities towards their neighbours' mean: creases calm down, swings go on."""
    old = v.copy()
    for i in range(len(v)):
        if inverse_mass[i] == 0.0:
            continue
        row, column = i // columns, i % columns
        down = min(row + 1, rows - 1) * columns + column
        mean = (
            old[max(row - 1, 0) * columns + column] + old[down]
            + old[row * columns + (column + 1) % columns] + old[row * columns + (column - 1) % columns]
        )  # fmt: skip
        v[i] += viscosity * (0.25 * mean - old[i])


@numba.njit(cache=True)
def _project_struts(x, inverse_mass, ends, lengths, compliance, dt, backwards):
    """Sweep all distance constraints once; the direction alternates so that no side is favoured."""
    count = len(lengths)
    for c in range(count):
        k = count - 1 - c if backwards else c
        i, j = ends[k, 0], ends[k, 1]
        weight = inverse_mass[i] + inverse_mass[j]
        if weight == 0.0:
            continue
        dx, dy, dz = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz) + 1e-12
        scale = -(length - lengths[k]) / (length * (weight + compliance[k] / (dt * dt)))
        wi, wj = scale * inverse_mass[i], scale * inverse_mass[j]
        x[i, 0] += wi * dx
        x[i, 1] += wi * dy
        x[i, 2] += wi * dz
        x[j, 0] -= wj * dx
        x[j, 1] -= wj * dy
        x[j, 2] -= wj * dz


@numba.njit(cache=True)
def _collide(
    x, previous, inverse_mass, nearest, neighbours,
    body0, body1, normals0, normals1, s0, s1, friction, thickness,
):  # fmt: skip
    """Push vertices out of the body's tangent planes and rub them along its motion."""
    for i in range(len(x)):
        if inverse_mass[i] == 0.0:
            continue
        j = _walk_to_nearest(x[i], nearest[i], neighbours, body0, body1, s1)
        nearest[i] = j
        contact = body0[j] + s1 * (body1[j] - body0[j])
        offset = x[i] - contact
        if (offset * offset).sum() > 0.01:
            continue
        n = normals0[j] + s1 * (normals1[j] - normals0[j])
        n /= np.sqrt((n * n).sum()) + 1e-12
        depth = thickness - (offset * n).sum()
        if depth <= 0.0:
            continue
        x[i] += depth * n
        carried = (s1 - s0) * (body1[j] - body0[j])
        slip = x[i] - previous[i] - carried
        slip -= n * (slip * n).sum()
        size = np.sqrt((slip * slip).sum()) + 1e-12
        x[i] -= slip * min(1.0, friction * depth / size)


@numba.njit(cache=True)
def _walk_to_nearest(point, start, neighbours, body0, body1, s):
    """Return the body vertex nearest to a point, by descent along edges from an earlier one."""
    current, best = start, 1e9
    for _ in range(8):
        following = current
        for k in range(neighbours.shape[1]):
            j = neighbours[current, k]
            squared = 0.0
            for axis in range(3):
                d = point[axis] - body0[j, axis] - s * (body1[j, axis] - body0[j, axis])
                squared += d * d
            if squared < best:
                best, following = squared, j
        if following == current:
            break
        current = following
    return current
