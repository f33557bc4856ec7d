"""The compiled solver of cloth: against its slow twin, and against what mechanics says."""

import dataclasses

import numpy as np
import pytest

from dsar.avatar.motion_prior import GRID
from dsar.dynamics import reference
from dsar.dynamics.cloth import ClothConstants
from dsar.dynamics.reference import ReferenceCloth
from dsar.dynamics.solver import CONTACT, FARTHEST, FASTEST
from tests.tubes import (
    COLUMNS,
    FPS,
    FREE,
    STEPS,
    Cloth,
    column_of_body,
    far_body,
    links,
    moments,
    moved,
    still,
    tube,
    turning,
)

G = 9.81
KINDS = {
    "usual": ClothConstants(),
    "close": ClothConstants(friction=0.3, core=0.9, thickness=0.03, pull=30.0, homing=2.0),
    "free": FREE,
}


def dance(frames, speed=4.0):
    """Return angles and ways of a body that turns one way, then the other, and goes from side to side."""
    t = np.arange(frames) / FPS
    angles = speed * t - 2.5 * speed * (t - 0.15).clip(0)
    return angles, np.stack([0.5 * np.sin(5 * t), 0.05 * np.sin(9 * t), 0.2 * t], -1)


@pytest.mark.parametrize("kind", KINDS)
def test_a_motion_ends_where_the_slow_twin_has_it(kind):
    body = column_of_body()
    cloth = Cloth.at_rest(KINDS[kind], body)
    twin, around = cloth.twin(), moved(tube(), body, *dance(11))
    found, expected = cloth.simulate(*around), twin.simulate(moments(*around), STEPS, FPS)
    assert np.abs(found - around[0][1:]).max() > 0.1
    assert np.abs(found - expected).max() < 1e-4
    assert np.array_equal(cloth.nearest, twin.nearest)
    assert np.abs(cloth.velocities - twin.velocities).max() < 1e-2


@pytest.mark.parametrize("kind", KINDS)
def test_every_step_of_a_motion_is_that_of_the_slow_twin(kind):
    body = column_of_body()
    cloth = Cloth.at_rest(KINDS[kind], body)
    around = moved(tube(), body, *dance(40, 8.0))
    for frame in range(39):
        twin, pair = cloth.twin(), [array[frame : frame + 2] for array in around]
        found = cloth.simulate(*pair, steps=1, fps=150.0)
        # Rounding: points lie within 2 m, whose single precision is 1e-7, and a step adds some of them.
        assert np.abs(found - twin.simulate(moments(*pair), 1, 150.0)).max() < 1e-6


def pendulum(angle):
    """Return cloth of one free row, each point of which hangs half a metre below its own held point."""
    rest = tube(2)
    rest[1, :, 0], rest[1, :, 2] = rest[0, :, 0], rest[0, :, 2]
    threads = links([(i, COLUMNS + i) for i in range(COLUMNS)], [0.5] * COLUMNS)
    cloth = Cloth.at_rest(FREE, far_body(), rest, threads)
    cloth.points[COLUMNS:] += 0.5 * np.array([np.sin(angle), 1 - np.cos(angle), 0], np.float32)
    return cloth, rest


def test_a_pendulum_has_its_period():
    cloth, rest = pendulum(0.1)
    swing = cloth.simulate(*still(rest, far_body(), 181))[:, COLUMNS, 0] - rest[1, 0, 0]
    sign = np.nonzero(np.diff(np.sign(swing)))[0]
    crossings = sign + swing[sign] / (swing[sign] - swing[sign + 1])
    periods = 2 * np.diff(crossings) / FPS
    assert len(periods) >= 7
    assert periods.mean() == pytest.approx(2 * np.pi * np.sqrt(0.5 / G), rel=0.01)


def test_a_thread_without_compliance_keeps_its_length():
    cloth, rest = pendulum(1.0)
    points = cloth.simulate(*still(rest, far_body(), 61))
    lengths = np.linalg.norm(points[:, :COLUMNS] - points[:, COLUMNS:], axis=-1)
    assert np.abs(lengths - 0.5).max() < 1e-5
    assert np.ptp(points[:, COLUMNS, 0]) > 0.5


def test_a_compliant_thread_gives_as_its_compliance_says():
    compliance = 2e-3
    rest = tube(2)
    rest[1, :, 0], rest[1, :, 2] = rest[0, :, 0], rest[0, :, 2]
    threads = links([(i, COLUMNS + i) for i in range(COLUMNS)], [0.5] * COLUMNS, compliance)
    cloth = Cloth.at_rest(dataclasses.replace(FREE, damping=3.0), far_body(), rest, threads)
    lowest = cloth.simulate(*still(rest, far_body(), 200))[-1, COLUMNS:, 1]
    # Of unit mass: force over stiffness.
    # Damping takes its share of a step's gravity, too.
    expected = G * compliance / (1 + 3.0 / FPS / STEPS)
    assert rest[1, :, 1] - lowest == pytest.approx(np.full(COLUMNS, expected), rel=1e-3)


def test_without_constraints_points_fall_as_stones_do():
    rest = tube()
    cloth = Cloth.at_rest(FREE, far_body(), constraints=links([], []))
    cloth.velocities[COLUMNS:, 0] = 0.5
    points = cloth.simulate(*still(rest, far_body(), 7))
    steps, dt = np.arange(1, 7) * STEPS, 1 / (FPS * STEPS)
    falls = points[:, COLUMNS:] - rest.reshape(-1, 3)[COLUMNS:]
    assert np.abs(falls[..., 1] + (G * dt**2 * steps * (steps + 1) / 2)[:, None]).max() < 1e-5
    assert np.abs(falls[..., 0] - 0.5 * (steps * dt)[:, None]).max() < 1e-5
    assert np.array_equal(points[:, :COLUMNS], np.repeat(rest[None, 0], 6, 0))


def test_constraints_between_free_points_keep_their_momentum():
    rng = np.random.default_rng(0)
    count = tube().shape[0] * COLUMNS
    ends = [tuple(rng.choice(np.arange(COLUMNS, count), 2, replace=False)) for _ in range(60)]
    flat = tube().reshape(-1, 3)
    lengths = [np.linalg.norm(flat[i] - flat[j]) * rng.uniform(0.95, 1.05) for i, j in ends]
    kept = links(ends, lengths, 1e-4)
    cloth = Cloth.at_rest(FREE, far_body(), constraints=kept)
    cloth.velocities[COLUMNS:] = rng.normal(0, 0.3, (count - COLUMNS, 3))
    before = cloth.velocities[COLUMNS:].mean(0)
    cloth.simulate(*still(tube(), far_body(), 4))
    assert np.abs(cloth.velocities[COLUMNS:]).max() < FASTEST / 2
    change = cloth.velocities[COLUMNS:].mean(0) - before
    assert change == pytest.approx([0, -3 * G / FPS, 0], abs=1e-3)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_one_sided_constraints_let_go_on_their_other_side(side):
    rest = tube(2)
    ends = [(i, COLUMNS + i) for i in range(COLUMNS)]
    lengths = np.linalg.norm(rest[0] - rest[1], axis=-1)
    free = Cloth.at_rest(FREE, far_body(), rest, links([], []))
    loose = Cloth.at_rest(FREE, far_body(), rest, links(ends, list(lengths + 0.3 * side), side=side))
    tight = Cloth.at_rest(FREE, far_body(), rest, links(ends, list(lengths - 0.1 * side), side=side))
    ways = [cloth.simulate(*still(rest, far_body(), 4)) for cloth in (free, loose, tight)]
    assert np.array_equal(ways[0], ways[1])
    assert np.linalg.norm(ways[0] - ways[2], axis=-1)[:, COLUMNS:].min() > 0.05


@pytest.mark.parametrize(("steepness", "slides"), [(0.9, False), (1.5, True)])
def test_friction_holds_below_the_coulomb_limit_and_brakes_above_it(steepness, slides):
    friction, thickness = 0.5, 0.006
    angle = np.arctan(steepness * friction)
    normal, downhill = (
        np.array([np.sin(angle), np.cos(angle), 0]),
        np.array([np.cos(angle), -np.sin(angle), 0]),
    )
    plane = (np.array([[0, 0.5, 0]]), normal[None], np.zeros((1, 1), np.int32))
    rest = tube(2)
    rest[1] = plane[0] + thickness * normal + 0.01 * np.arange(COLUMNS)[:, None] * np.array([0, 0, 1])
    constants = dataclasses.replace(FREE, friction=friction, thickness=thickness)
    cloth = Cloth.at_rest(constants, plane, rest, links([], []))
    points = cloth.simulate(*still(rest, plane, 10))[-1, COLUMNS:]
    way = (points - rest[1]) @ downhill
    expected = 0.5 * G * (np.sin(angle) - friction * np.cos(angle)) * (9 / FPS) ** 2 if slides else 0
    assert way == pytest.approx(np.full(COLUMNS, expected), rel=0.05, abs=1e-5)


def test_friction_carries_points_along_with_the_skin_until_they_are_as_fast():
    friction, thickness, speed = 0.5, 0.006, 0.2
    plane = (np.array([[0, 0.5, 0]]), np.array([[0, 1.0, 0]]), np.zeros((1, 1), np.int32))
    rest = tube(2)
    rest[1] = plane[0] + 0.01 * np.arange(COLUMNS)[:, None] * np.array([0, 0, 1])
    rest[1, :, 1] += thickness
    home, body, normals = still(rest, plane, 10)
    body = body + np.array([speed, 0, 0]) * np.arange(10)[:, None, None] / FPS
    for coefficient in (friction, 0.0):
        constants = dataclasses.replace(FREE, friction=coefficient, thickness=thickness)
        cloth = Cloth.at_rest(constants, plane, rest, links([], []))
        way = cloth.simulate(home, body, normals)[-1, COLUMNS:, 0] - rest[1, :, 0]
        expected = speed * 9 / FPS - speed**2 / (2 * friction * G) if coefficient else 0
        # The brake acts by whole steps.
        assert way == pytest.approx(np.full(COLUMNS, expected), abs=speed / FPS / STEPS)


@pytest.mark.parametrize("kind", ["usual", "close"])
def test_no_point_enters_the_tangent_plane_of_its_nearest_body_point(kind):
    body = column_of_body()
    cloth = Cloth.at_rest(dataclasses.replace(KINDS[kind], core=0.0), body)
    around = moved(tube(), body, *dance(60, 8.0))
    touched = 0
    for frame in range(59):
        points = cloth.simulate(*(array[frame : frame + 2] for array in around))[0, COLUMNS:]
        j = cloth.nearest[COLUMNS:]
        way = points - around[1][frame + 1, j]
        inside = np.linalg.norm(way, axis=1) < CONTACT
        height = (way * around[2][frame + 1, j]).sum(1)
        assert (height[inside] > KINDS[kind].thickness - 1e-5).all()
        touched += (inside & (height < KINDS[kind].thickness + 1e-4)).sum()
    assert touched > 50


def test_without_gravity_rest_is_rest(monkeypatch):
    monkeypatch.setattr(reference, "GRAVITY", 0.0)
    constants = dataclasses.replace(ClothConstants(), slack=1.0, give=1.0)
    body = column_of_body()
    twin = Cloth.at_rest(constants, body).twin()
    points = twin.simulate(moments(*still(tube(), body, 31)), STEPS, FPS)
    # Rest lengths are single precision.
    assert np.abs(points - tube().reshape(-1, 3)).max() < 1e-5


def test_where_gravity_and_the_way_home_are_even_points_stay():
    constants = dataclasses.replace(FREE, pull=50.0)
    cloth = Cloth.at_rest(constants, far_body(), constraints=links([], []))
    cloth.points[COLUMNS:, 1] -= G / 50.0
    before = cloth.points.copy()
    assert np.abs(cloth.simulate(*still(tube(), far_body(), 31)) - before).max() < 1e-4


def test_a_turned_and_shifted_motion_moves_cloth_alike():
    body, turn, shift = column_of_body(), turning(1.1), np.array([0.7, 0.2, -0.4])
    around = moved(tube(), body, *dance(16))
    elsewhere = [around[0] @ turn.T + shift, around[1] @ turn.T + shift, around[2] @ turn.T]
    here, there = Cloth.at_rest(ClothConstants(), body), Cloth.at_rest(ClothConstants(), body)
    there.points = (there.points @ turn.T + shift).astype(np.float32)
    found = here.simulate(*around), there.simulate(*elsewhere)
    assert np.abs(found[0] @ turn.T + shift - found[1]).max() < 1e-4


def radii(points, home):
    """Return how far points are from the vertical through their row's middle, by row."""
    grid, home = points.reshape(-1, COLUMNS, 3), home.reshape(-1, COLUMNS, 3)
    return np.linalg.norm((grid - home.mean(1, keepdims=True))[..., ::2], axis=-1)


def test_the_core_keeps_the_tube_open_in_a_fast_twist():
    twist = np.concatenate([np.linspace(0, 14, 20), np.full(10, 14.0)]), np.zeros((30, 3))
    smallest = {}
    for core in (0.0, 0.7):
        constants = dataclasses.replace(
            ClothConstants(), core=core, drag=8.0, viscosity=0.0, homing=0.0, pull=0.0
        )
        cloth = Cloth.at_rest(constants, far_body())
        home = moved(tube(), far_body(), *twist)[0]
        points = cloth.simulate(*moved(tube(), far_body(), *twist))
        shares = [radii(p, h)[1:] / radii(h, h)[1:] for p, h in zip(points, home[1:], strict=True)]
        smallest[core] = np.min(shares)
    assert smallest[0.7] > 0.7 - 1e-3
    assert smallest[0.0] < 0.65


LOST = ("hem over the waist", "pulled through", "twisted", "turned about", "crumpled")


def lost(rest, state):
    """Return points from which cloth has to come home."""
    points, rows = rest.copy(), len(rest)
    if state == "hem over the waist":
        points[1:, :, 1] = 2 * rest[0, 0, 1] - points[1:, :, 1]
    elif state == "pulled through":
        points[1:] = 2 * rest[0].mean(0) - points[1:]
    elif state == "twisted":
        for row in range(1, rows):
            points[row] = points[row] @ turning(np.pi * row / (rows - 1)).T
    elif state == "turned about":
        points[1:] = points[1:] @ turning(np.pi).T
    else:
        points[1:] = np.random.default_rng(0).normal(0, 1, points[1:].shape)
    return points.reshape(-1, 3)


@pytest.mark.parametrize("state", LOST)
def test_cloth_comes_home_from_any_state(state):
    body, rest = column_of_body(), tube(*GRID)
    seconds = still(rest, body, 240)
    hanging = Cloth.at_rest(ClothConstants(), body, rest).simulate(*seconds)[-1]
    cloth = Cloth.at_rest(ClothConstants(), body, rest)
    cloth.points = lost(rest, state)
    points = cloth.simulate(*seconds)
    ways = np.linalg.norm(points - rest.reshape(-1, 3), axis=-1)
    assert ways.max() < FARTHEST + 1e-5
    assert ways[0].max() > 0.1
    # Folds may come to lie beside where they were.
    assert np.linalg.norm(points[-1] - hanging, axis=-1).max() < 0.05


def test_no_point_is_farther_or_faster_than_the_limits():
    body = column_of_body()
    cloth = Cloth.at_rest(ClothConstants(), body)
    ways = np.cumsum(np.random.default_rng(0).normal(0, 1, (20, 3)), 0)
    around = moved(tube(), body, np.zeros(20), ways)
    for frame in range(19):
        points = cloth.simulate(*(array[frame : frame + 2] for array in around))[0]
        assert np.linalg.norm(points - around[0][frame + 1], axis=-1).max() < FARTHEST + 1e-5
        assert np.linalg.norm(cloth.velocities, axis=-1).max() < FASTEST + 1e-3
        assert np.isfinite(points).all()


def test_the_slow_twin_has_its_own_precision():
    cloth = Cloth.at_rest(ClothConstants(), column_of_body())
    twin = cloth.twin()
    assert isinstance(twin, ReferenceCloth)
    assert twin.points.dtype == twin.velocities.dtype == np.float64
