"""A garment's simulation on the body: in parts, across cuts and rates; its collider."""

import dataclasses

import numpy as np
import pytest
import torch

from dsar.avatar.driving import DrivingSignal
from dsar.avatar.motion_prior import GRID, hang
from dsar.body.files import load_body
from dsar.body.skinning import forward_kinematics
from dsar.dynamics import simulation as simulations
from dsar.dynamics.cloth import ClothConstants
from dsar.dynamics.collider import BodyCollider
from dsar.dynamics.simulation import ClothSimulation
from dsar.geometry.rotations import matrix_from_axis_angle
from dsar.types import Motion
from tests.loose_cloth import FPS, skirt_avatar, striding

BODY = load_body()


@pytest.fixture(scope="module")
def skirt() -> ClothSimulation:
    avatar = skirt_avatar(prior="cloth")
    assert avatar.prior is not None
    return avatar.prior.garments[0].simulation(avatar.body)


def transforms_of(motion: Motion) -> torch.Tensor:
    return forward_kinematics(BODY, motion.rotations, motion.translations)


def fabric_of(skirt, **changes):
    return skirt.fabric(dataclasses.replace(ClothConstants(), **changes))


def test_a_motion_in_chunks_is_the_motion_at_once_to_the_bit(skirt, monkeypatch):
    monkeypatch.setattr(simulations, "_CHUNK", 7)
    transforms, fabric = transforms_of(striding(31, 1, "walk")), fabric_of(skirt)
    whole = skirt.displacements(skirt.stage(transforms), fabric, FPS)
    assert whole.abs().max() > 0.02
    assert torch.equal(skirt.follow(transforms, fabric, FPS), whole)


def test_a_way_from_home_is_carried_back_exactly_and_fades_where_skinning_flattens_space():
    turns = torch.stack(
        [torch.eye(3), torch.diag(torch.tensor([1.0, 0.9, 0.4])), torch.diag(torch.tensor([1.0, 0.1, 0.1]))]
    )
    turns = (rotation := matrix_from_axis_angle(torch.tensor([0.3, -0.8, 0.5]))) @ turns
    home = np.zeros((1, 3, 3), np.float32)
    stage = simulations.Stage(home, home, home, turns[None])
    way = torch.tensor([0.03, 0.2, -0.1])
    found = simulations.displace((turns @ way).numpy()[None], stage)[0]
    torch.testing.assert_close(found[:2], way.expand(2, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(found[2], way * 0.01 / simulations.LEAST_VOLUME, atol=1e-6, rtol=0)
    # However flat: never farther than this.
    flat = simulations.displace((rotation @ way).numpy()[None, None].repeat(3, 1), stage)[0]
    assert float(flat.norm(dim=-1).max()) < float(way.norm()) / simulations.LEAST_VOLUME


@pytest.mark.parametrize("frames", [1, 2])
def test_short_motions_have_a_displacement_for_each_frame(skirt, frames):
    transforms = transforms_of(striding(frames, 1, "walk"))
    assert len(skirt.follow(transforms, fabric_of(skirt), FPS)) == frames


def test_a_state_that_is_carried_goes_on_to_the_bit_and_is_not_changed(skirt):
    stage, fabric = skirt.stage(transforms_of(striding(30, 2, "walk"))), fabric_of(skirt)

    def part(first, last):
        arrays = (array[first:last] for array in (stage.home, stage.body, stage.normals))
        return simulations.Stage(*arrays, stage.turns[first:last])

    start = skirt.begin(stage, fabric, FPS)
    whole, end = skirt.advance(start, stage, fabric, FPS)
    first, middle = skirt.advance(start, part(0, 13), fabric, FPS)
    kept = middle.copy()
    again = [skirt.advance(middle, part(12, 30), fabric, FPS) for _ in range(2)]
    for rest, last in again:
        assert np.array_equal(np.concatenate([first, rest]), whole)
        for name in ("points", "velocities", "nearest"):
            assert np.array_equal(getattr(last, name), getattr(end, name))
            assert np.array_equal(getattr(middle, name), getattr(kept, name))


def test_no_frame_knows_of_those_after_it(skirt):
    fabric, one, two = fabric_of(skirt), striding(40, 3, "one"), striding(40, 4, "two")
    cut = 20
    rotations = torch.cat([one.rotations[:cut], two.rotations[cut:]])
    translations = torch.cat([one.translations[:cut], two.translations[cut:]])
    mixed = Motion(rotations, translations, FPS, "mixed")
    found = [skirt.follow(transforms_of(motion), fabric, FPS) for motion in (one, mixed)]
    assert torch.equal(found[0][:cut], found[1][:cut])
    assert not torch.equal(found[0][cut], found[1][cut])


def standing(frames: int) -> Motion:
    return Motion(torch.zeros(frames, 55, 3), torch.zeros(frames, 3), FPS, "standing")


def test_cloth_that_hangs_goes_on_hanging(skirt):
    fabric, transforms = fabric_of(skirt), transforms_of(standing(45))
    hanging = hang(skirt, fabric, [skirt.stage(transforms[:1])], FPS)
    assert hanging.norm(dim=-1).max() > 1e-3
    offsets = skirt.follow(transforms, fabric, FPS, hanging) - hanging
    assert offsets.norm(dim=-1).max() < 2e-3


def test_hanging_is_the_mean_of_some_poses(skirt):
    fabric = fabric_of(skirt)
    stages = [skirt.stage(transforms_of(striding(40, 5, "walk"))[[frame]]) for frame in (0, 39)]
    single = [hang(skirt, fabric, [stage], FPS) for stage in stages]
    torch.testing.assert_close(hang(skirt, fabric, stages, FPS), (single[0] + single[1]) / 2)


def test_a_body_that_is_put_elsewhere_takes_its_cloth_along(skirt):
    motion, fabric = striding(40, 6, "walk"), fabric_of(skirt)
    translations, rotations = motion.translations.clone(), motion.rotations.clone()
    translations[20:] += torch.tensor([5.0, 0, -3])
    cut = Motion(rotations, translations, FPS, "cut")
    steady = [DrivingSignal.of_motion(BODY, each, (0.1,)).steady for each in (motion, cut)]
    found = [skirt.follow(transforms, fabric, FPS) for transforms in steady]
    # Where a jump leads the body is extrapolated from the two frames before it.
    assert (found[0] - found[1]).norm(dim=-1).max() < 5e-3
    assert (found[0][:20] - found[1][:20]).abs().max() == 0


def test_a_turned_and_shifted_motion_is_the_motion(skirt):
    transforms, fabric = transforms_of(striding(30, 7, "walk")), fabric_of(skirt)
    elsewhere = torch.eye(4)
    angle = torch.tensor(2.1)
    elsewhere[0, 0] = elsewhere[2, 2] = angle.cos()
    elsewhere[0, 2], elsewhere[2, 0] = angle.sin(), -angle.sin()
    elsewhere[:3, 3] = torch.tensor([1.0, 0.1, -2.0])
    found = [skirt.follow(moved, fabric, FPS) for moved in (transforms, elsewhere @ transforms)]
    # Rounding decides single contacts.
    assert (found[0] - found[1]).norm(dim=-1).mean() < 1e-3


def test_the_same_motion_at_twice_the_rate_moves_cloth_nearly_alike(skirt):
    slow, fabric = striding(60, 8, "walk"), fabric_of(skirt)
    # Halfway between frames: joints are interpolated as the solver does, so that only steps differ.
    transforms = transforms_of(slow)
    fast = torch.stack([transforms[:-1], (transforms[:-1] + transforms[1:]) / 2], 1).flatten(0, 1)
    fast = torch.cat([fast, transforms[-1:]])
    one, two = skirt.follow(transforms, fabric, FPS), skirt.follow(fast, fabric, 2 * FPS)[::2]
    moved = (one - one[:1]).norm(dim=-1).mean()
    # 150 steps a second are five of a frame at 30, and at 60 two and a half, so two: longer steps give
    # compliances and damping a little more of their way.
    assert (one - two).norm(dim=-1).mean() < 0.2 * moved


def test_the_cloth_on_a_motion_without_end_stays_finite_and_near(skirt):
    rng = torch.Generator().manual_seed(0)
    rotations = 1.5 * torch.randn(40, 55, 3, generator=rng)
    wild = Motion(rotations, torch.randn(40, 3, generator=rng), FPS, "wild")
    offsets = skirt.follow(transforms_of(wild), fabric_of(skirt), FPS)
    assert offsets.isfinite().all()


# The grid.


# The collider.


@pytest.fixture(scope="module")
def collider() -> BodyCollider:
    return BodyCollider(BODY, float(BODY.joints[0, 1]) + 0.1, float(BODY.joints[0, 1]) - 0.5)


def test_the_collider_is_a_thin_skin_with_outward_normals_and_without_arms(collider):
    assert 200 < len(collider) < 3000
    torch.testing.assert_close(collider.normals.norm(dim=-1), torch.ones(len(collider)))
    torch.testing.assert_close(collider.weights.sum(1), torch.ones(len(collider)))
    points, normals = collider.pose(torch.eye(4).expand(2, 55, 4, 4))
    torch.testing.assert_close(points[1], collider.points, atol=1e-5, rtol=0)
    torch.testing.assert_close(normals[0], collider.normals, atol=1e-5, rtol=0)
    # A step outwards leads away from what is around.
    near = collider.points[torch.from_numpy(collider.neighbours).long()].mean(1)
    outwards = ((collider.points - near) * collider.normals).sum(-1)
    assert (outwards > -0.01).float().mean() > 0.95


def walk(skirt, transforms, fabric):
    """Yield the cloth's state in each frame of a motion, the body's points and their normals."""
    stage = skirt.stage(transforms)
    state = skirt.begin(stage, fabric, FPS)
    for frame in range(len(transforms) - 1):
        arrays = (array[frame : frame + 2] for array in (stage.home, stage.body, stage.normals))
        pair = simulations.Stage(*arrays, stage.turns[frame : frame + 2])
        _, state = skirt.advance(state, pair, fabric, FPS)
        yield state, stage.body[frame + 1], stage.normals[frame + 1]


def test_the_walk_finds_the_nearest_body_point_nearly_always(skirt):
    found = []
    for state, body, _ in walk(skirt, transforms_of(striding(60, 9, "walk")), fabric_of(skirt)):
        points = state.points[GRID[1] :]
        distances = np.linalg.norm(points[:, None] - body, axis=-1)
        own = np.take_along_axis(distances, state.nearest[GRID[1] :, None].astype(np.int64), 1)[:, 0]
        # Far from the body its planes say nothing. The walk ended before the points were pushed a little.
        close = distances.min(1) < 0.12
        found.append((own < distances.min(1) + 5e-3)[close])
    assert len(np.concatenate(found)) > 1000
    assert np.concatenate(found).mean() > 0.93


def test_no_point_outside_one_leg_takes_the_other_leg_s_inside_for_nearest(skirt):
    wrong = total = 0
    for state, body, normals in walk(skirt, transforms_of(striding(60, 9, "walk")), fabric_of(skirt)):
        points, j = state.points[GRID[1] :], state.nearest[GRID[1] :]
        distance = np.linalg.norm(points - body[j], axis=1)
        behind = ((points - body[j]) * normals[j]).sum(1) < -0.03
        wrong += (behind & (distance < 0.12)).sum()
        total += (distance < 0.12).sum()
    assert total > 1000
    assert wrong == 0
