"""Extended position-based dynamics of a coarse tube of cloth on a moving body, in one compiled pass.

Small steps with one Gauss-Seidel sweep each (Macklin et al. 2019). What makes it a prior that can be trusted:
a weak spring draws every point home to where skinning carries the resting garment, no point gets farther from
there than a limit or faster than another, and so there is no state from which it does not come back.

World: metres, seconds, Y up. `dsar.dynamics.reference` is the slow twin.
"""

import numpy as np

from dsar.raster.jit import inlined, kernel

GRAVITY = np.float32(9.81)
CONTACT = np.float32(0.12)
"""Metres from a body point beyond which its tangent plane says nothing about the cloth."""
FARTHEST = np.float32(0.6)
"""Metres from home that no point exceeds."""
FASTEST = np.float32(20.0)
"""Metres per second that no point exceeds."""
_ZERO, _ONE, _QUARTER, _TINY = np.float32(0), np.float32(1), np.float32(0.25), np.float32(1e-12)


@kernel
def simulate(
    points, velocities, nearest, home, body, normals, neighbours, ends, lengths, compliances, sides,
    constants, shape, steps, fps, positions,
):  # fmt: skip
    """Advance the cloth through all frames but the first, whose state is given; all arrays are float32.

    `points` and `velocities` are the state of n = rows x columns points, row by row from the top, `nearest`
    the index of the body point nearest to each; they are changed in place. The first row is fixed to its
    `home`, [f, n, 3], where skinning carries the resting garment. `body` and `normals`, [f, b, 3], are points
    of the body with outward unit normals, and `neighbours`, [b, k], those around each.

    Distance constraints have `ends` [m, 2], `lengths` and `compliances` [m]; of `sides` 1 they resist only
    being stretched, of -1 only being pressed, of 0 both. `constants` are `ClothConstants.of_motion`, `shape`
    is rows and columns, and `steps` those of a frame. `positions`, [f - 1, n, 3], receives the points.
    """
    rows, columns = shape
    previous, before = np.empty_like(points), np.empty_like(points)
    centers_before, centers = _row_centers(home[0], rows, columns), _row_centers(home[0], rows, columns)
    step_time = np.float32(1.0 / (fps * steps))
    for frame in range(1, len(home)):
        centers_before, centers = centers, _row_centers(home[frame], rows, columns)
        for step in range(steps):
            fraction = np.float32((step + 1.0) / steps)
            before[:] = velocities
            _accelerate(
                points, velocities, before, home[frame - 1], home[frame], fraction, np.float32(fps),
                constants, rows, columns, step_time,
            )  # fmt: skip
            previous[:] = points
            _move(points, velocities, home[frame - 1], home[frame], fraction, columns, step_time)
            _sweep(points, ends, lengths, compliances, sides, columns, step_time, step % 2)
            _follow_nearest(points, nearest, body[frame - 1], body[frame], fraction, neighbours, columns)
            _collide(
                points, previous, nearest, body[frame - 1], body[frame], normals[frame - 1], normals[frame],
                fraction, np.float32(1.0 / steps), constants, columns,
            )  # fmt: skip
            _stay_open(
                points, home[frame - 1], home[frame], centers_before, centers, fraction, constants[7], columns
            )
            _limit(points, previous, velocities, home[frame - 1], home[frame], fraction, columns, step_time)
        positions[frame - 1] = points


@inlined
def _follow_nearest(points, nearest, body_before, body, fraction, neighbours, columns):
    """Walk from each point's last nearest body point downhill to a nearest one."""
    for i in range(columns, len(points)):
        j = nearest[i]
        best = _squared_distance(points, i, body_before, body, fraction, j)
        while True:
            start = j
            for k in range(neighbours.shape[1]):
                other = neighbours[start, k]
                distance = _squared_distance(points, i, body_before, body, fraction, other)
                if distance < best:
                    best, j = distance, other
            if j == start:
                break
        nearest[i] = j


@inlined
def _squared_distance(points, i, body_before, body, fraction, j):
    x = points[i, 0] - body_before[j, 0] - fraction * (body[j, 0] - body_before[j, 0])
    y = points[i, 1] - body_before[j, 1] - fraction * (body[j, 1] - body_before[j, 1])
    z = points[i, 2] - body_before[j, 2] - fraction * (body[j, 2] - body_before[j, 2])
    return x * x + y * y + z * z


@inlined
def _accelerate(
    points, velocities, before, home_before, home, fraction, fps, constants, rows, columns, step_time
):
    """Apply gravity, air, the cloth's inner friction and the way home to the velocities."""
    drag, damping, viscosity = constants[0], constants[1], constants[2]
    pull, homing = constants[5], constants[6]
    share = min(step_time * viscosity, np.float32(0.5))
    fade = _ONE / (_ONE + step_time * (damping + homing))
    for row in range(1, rows):
        above, below = (row - 1) * columns, min(row + 1, rows - 1) * columns
        for column in range(columns):
            left, right = column - 1 if column else columns - 1, column + 1 if column + 1 < columns else 0
            i, up, down = row * columns + column, above + column, below + column
            left, right = row * columns + left, row * columns + right
            ax, ay, az = (
                points[down, 0] - points[up, 0],
                points[down, 1] - points[up, 1],
                points[down, 2] - points[up, 2],
            )
            bx, by, bz = (
                points[right, 0] - points[left, 0],
                points[right, 1] - points[left, 1],
                points[right, 2] - points[left, 2],
            )
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            scale = _ONE / (np.sqrt(nx * nx + ny * ny + nz * nz) + _TINY)
            nx, ny, nz = nx * scale, ny * scale, nz * scale
            across = before[i, 0] * nx + before[i, 1] * ny + before[i, 2] * nz
            braked = across * (_ONE / (_ONE + step_time * drag * abs(across)) - _ONE)
            for k in range(3):
                normal = nx if k == 0 else (ny if k == 1 else nz)
                mean = _QUARTER * (before[up, k] + before[down, k] + before[left, k] + before[right, k])
                way = home_before[i, k] + fraction * (home[i, k] - home_before[i, k]) - points[i, k]
                speed = velocities[i, k] + normal * braked + share * (mean - before[i, k])
                speed += step_time * (pull * way + homing * fps * (home[i, k] - home_before[i, k]))
                if k == 1:
                    speed -= step_time * GRAVITY
                velocities[i, k] = speed * fade


@inlined
def _move(points, velocities, home_before, home, fraction, columns, step_time):
    for i in range(columns):
        for k in range(3):
            points[i, k] = home_before[i, k] + fraction * (home[i, k] - home_before[i, k])
    for i in range(columns, len(points)):
        for k in range(3):
            points[i, k] += step_time * velocities[i, k]


@inlined
def _sweep(points, ends, lengths, compliances, sides, columns, step_time, backwards):
    """Project every constraint once, in turn from either end."""
    count = len(ends)
    rate = _ONE / (step_time * step_time)
    for place in range(count):
        c = count - 1 - place if backwards else place
        i, j = ends[c, 0], ends[c, 1]
        dx, dy, dz = (
            points[i, 0] - points[j, 0],
            points[i, 1] - points[j, 1],
            points[i, 2] - points[j, 2],
        )
        length = np.sqrt(dx * dx + dy * dy + dz * dz) + _TINY
        excess = length - lengths[c]
        if sides[c] * excess < _ZERO:
            continue
        free_i, free_j = _ZERO if i < columns else _ONE, _ZERO if j < columns else _ONE
        scale = excess / (length * (free_i + free_j + compliances[c] * rate))
        points[i, 0] -= free_i * scale * dx
        points[i, 1] -= free_i * scale * dy
        points[i, 2] -= free_i * scale * dz
        points[j, 0] += free_j * scale * dx
        points[j, 1] += free_j * scale * dy
        points[j, 2] += free_j * scale * dz


@inlined
def _collide(
    points, previous, nearest, body_before, body, normals_before, normals, fraction, share, constants, columns
):
    """Push points out of the tangent plane of their nearest body point, and let them rub against it."""
    friction, thickness = constants[3], constants[4]
    for i in range(columns, len(points)):
        j = nearest[i]
        mx, my, mz = (
            body[j, 0] - body_before[j, 0],
            body[j, 1] - body_before[j, 1],
            body[j, 2] - body_before[j, 2],
        )
        ox, oy, oz = (
            points[i, 0] - body_before[j, 0] - fraction * mx,
            points[i, 1] - body_before[j, 1] - fraction * my,
            points[i, 2] - body_before[j, 2] - fraction * mz,
        )
        if ox * ox + oy * oy + oz * oz > CONTACT * CONTACT:
            continue
        nx = normals_before[j, 0] + fraction * (normals[j, 0] - normals_before[j, 0])
        ny = normals_before[j, 1] + fraction * (normals[j, 1] - normals_before[j, 1])
        nz = normals_before[j, 2] + fraction * (normals[j, 2] - normals_before[j, 2])
        scale = _ONE / (np.sqrt(nx * nx + ny * ny + nz * nz) + _TINY)
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        depth = thickness - (ox * nx + oy * ny + oz * nz)
        if depth <= _ZERO:
            continue
        points[i, 0] += depth * nx
        points[i, 1] += depth * ny
        points[i, 2] += depth * nz
        sx, sy, sz = (
            points[i, 0] - previous[i, 0] - share * mx,
            points[i, 1] - previous[i, 1] - share * my,
            points[i, 2] - previous[i, 2] - share * mz,
        )
        across = sx * nx + sy * ny + sz * nz
        sx, sy, sz = sx - across * nx, sy - across * ny, sz - across * nz
        slip = np.sqrt(sx * sx + sy * sy + sz * sz) + _TINY
        held = min(_ONE, friction * depth / slip)
        points[i, 0] -= held * sx
        points[i, 1] -= held * sy
        points[i, 2] -= held * sz


@inlined
def _row_centers(home, rows, columns):
    """Return the middle of each row."""
    centers = np.zeros((rows, 3), np.float32)
    for row in range(rows):
        for column in range(columns):
            for k in range(3):
                centers[row, k] += home[row * columns + column, k] / np.float32(columns)
    return centers


@inlined
def _stay_open(points, home_before, home, centers_before, centers, fraction, core, columns):
    """Keep points away from the line through the rows' middles: the body is there.

    Points of the skin alone would let a tube that twists close between the legs.
    """
    rows = len(centers)
    for row in range(1, rows):
        low, high = max(row - 1, 0), min(row + 1, rows - 1)
        mx = centers_before[row, 0] + fraction * (centers[row, 0] - centers_before[row, 0])
        my = centers_before[row, 1] + fraction * (centers[row, 1] - centers_before[row, 1])
        mz = centers_before[row, 2] + fraction * (centers[row, 2] - centers_before[row, 2])
        ax, ay, az = (
            centers[high, 0] - centers[low, 0],
            centers[high, 1] - centers[low, 1],
            centers[high, 2] - centers[low, 2],
        )
        scale = _ONE / (np.sqrt(ax * ax + ay * ay + az * az) + _TINY)
        ax, ay, az = ax * scale, ay * scale, az * scale
        for i in range(row * columns, (row + 1) * columns):
            hx = home_before[i, 0] + fraction * (home[i, 0] - home_before[i, 0]) - mx
            hy = home_before[i, 1] + fraction * (home[i, 1] - home_before[i, 1]) - my
            hz = home_before[i, 2] + fraction * (home[i, 2] - home_before[i, 2]) - mz
            px, py, pz = points[i, 0] - mx, points[i, 1] - my, points[i, 2] - mz
            along = px * ax + py * ay + pz * az
            px, py, pz = px - along * ax, py - along * ay, pz - along * az
            rise = hx * ax + hy * ay + hz * az
            least = core * np.sqrt(max(hx * hx + hy * hy + hz * hz - rise * rise, _ZERO))
            distance = np.sqrt(px * px + py * py + pz * pz) + _TINY
            if distance < least:
                push = least / distance - _ONE
                points[i, 0] += push * px
                points[i, 1] += push * py
                points[i, 2] += push * pz


@inlined
def _limit(points, previous, velocities, home_before, home, fraction, columns, step_time):
    """Keep every point within reach of its home, and take the velocities from what has become of the step."""
    rate = _ONE / step_time
    for i in range(len(points)):
        hx, hy, hz = (
            home_before[i, 0] + fraction * (home[i, 0] - home_before[i, 0]),
            home_before[i, 1] + fraction * (home[i, 1] - home_before[i, 1]),
            home_before[i, 2] + fraction * (home[i, 2] - home_before[i, 2]),
        )
        dx, dy, dz = points[i, 0] - hx, points[i, 1] - hy, points[i, 2] - hz
        far = np.sqrt(dx * dx + dy * dy + dz * dz)
        if far > FARTHEST:
            scale = FARTHEST / far
            points[i, 0], points[i, 1], points[i, 2] = hx + scale * dx, hy + scale * dy, hz + scale * dz
        vx, vy, vz = (
            rate * (points[i, 0] - previous[i, 0]),
            rate * (points[i, 1] - previous[i, 1]),
            rate * (points[i, 2] - previous[i, 2]),
        )
        speed = np.sqrt(vx * vx + vy * vy + vz * vz)
        if speed > FASTEST:
            scale = FASTEST / speed
            vx, vy, vz = scale * vx, scale * vy, scale * vz
        velocities[i, 0], velocities[i, 1], velocities[i, 2] = vx, vy, vz
