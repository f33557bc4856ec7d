"""Frames with those beside them, and the times between."""

import dataclasses
import math
from itertools import pairwise

import pytest
import torch
from scenes import some
from torch import Tensor
from torch.nn.functional import normalize

from dsar.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_axis_angle,
)
from dsar.types import Gaussians, GaussianSequence
from dsar_render.triplets import FrameTriplet, add_neighbours, iterate_triplets


@pytest.fixture
def three() -> FrameTriplet:
    return FrameTriplet(1002, some(seed=1), some(seed=2), some(seed=3))


def test_at_no_offset_the_frame_is_itself(three):
    assert three.interpolate(0.0) is three.current


@pytest.mark.parametrize(("offset", "name"), [(-1.0, "previous"), (1.0, "following")])
def test_a_whole_frame_away_is_that_frame(three, offset, name):
    found, expected = three.interpolate(offset), getattr(three, name)
    for field in ("means", "scales", "opacities", "harmonics"):
        assert torch.equal(getattr(found, field), getattr(expected, field))
    # As rotations: a quaternion and its negative are one.
    torch.testing.assert_close(
        matrix_from_quaternion(found.rotations), matrix_from_quaternion(expected.rotations)
    )


@pytest.mark.parametrize("offset", [-0.75, -0.25, 0.125, 0.5])
def test_between_frames_everything_but_rotations_changes_linearly(three, offset):
    other = three.following if offset > 0 else three.previous
    found, share = three.interpolate(offset), abs(offset)
    for field in ("means", "scales", "opacities", "harmonics"):
        start, end = getattr(three.current, field), getattr(other, field)
        torch.testing.assert_close(getattr(found, field), (1 - share) * start + share * end)
    torch.testing.assert_close(found.rotations.norm(dim=-1), torch.ones(6))


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["same sign", "flipped"])
@pytest.mark.parametrize("degrees", [40.0, 130.0])
def test_rotations_take_the_shorter_arc_whatever_their_signs(sign, degrees):
    axis = normalize(torch.tensor([0.3, 1.0, -0.2]), dim=0)
    start, half, end = (
        quaternion_from_axis_angle(axis * math.radians(angle)).expand(6, 4)
        for angle in (10, 10 + degrees / 2, 10 + degrees)
    )
    now, after = (
        dataclasses.replace(some(), rotations=rotations) for rotations in (start.clone(), sign * end)
    )
    found = FrameTriplet(1001, now, following=after)
    torch.testing.assert_close(
        matrix_from_quaternion(found.interpolate(0.5).rotations),
        matrix_from_quaternion(half),
        atol=1e-6,
        rtol=0,
    )
    steps = [
        (found.interpolate(share).rotations * end).sum(-1).abs() for share in (0.0, 0.25, 0.5, 0.75, 1.0)
    ]
    assert all((later > earlier).all() for earlier, later in pairwise(steps))


def test_half_a_turn_ends_where_it_should():
    # Quaternions at right angles: neither arc is the shorter one, and their product's sign is 0.
    now, after = (
        dataclasses.replace(some(1), rotations=torch.tensor([rotation]))
        for rotation in ([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0])
    )
    triplet = FrameTriplet(1001, now, following=after)
    torch.testing.assert_close(triplet.interpolate(1.0).rotations.abs(), after.rotations)
    torch.testing.assert_close(
        triplet.interpolate(0.5).rotations.abs(), torch.tensor([[math.sqrt(0.5), 0, math.sqrt(0.5), 0]])
    )


@pytest.mark.parametrize(("triplet", "offset"), [("first", -0.5), ("last", 0.5), ("last", 1.0)])
def test_beyond_the_ends_of_a_motion_everything_stands_still(triplet, offset):
    ends = {
        "first": FrameTriplet(1, some(), following=some(seed=1)),
        "last": FrameTriplet(1, some(), previous=some(seed=1)),
    }
    assert ends[triplet].interpolate(offset) is ends[triplet].current


def sequence(*numbers: int, made: list[int] | None = None) -> GaussianSequence:
    def produce():
        for number in numbers:
            if made is not None:
                made.append(number)
            yield some(seed=number)

    return GaussianSequence(numbers, 24.0, 6, produce)


def seeds(triplet: FrameTriplet) -> tuple[int, int | None, int | None]:
    """Return the frame and which ones come before and after it, by what they hold."""
    known = {float(some(seed=number).means[0, 0]): number for number in range(1, 12)}

    def which(gaussians: Gaussians | None) -> int | None:
        return None if gaussians is None else known[float(gaussians.means[0, 0])]

    assert which(triplet.current) == triplet.frame
    return triplet.frame, which(triplet.previous), which(triplet.following)


def test_every_frame_comes_with_those_beside_it():
    found = [seeds(each) for each in iterate_triplets(sequence(1, 2, 3, 4), range(1, 5))]
    assert found == [(1, None, 2), (2, 1, 3), (3, 2, 4), (4, 3, None)]


def test_frames_that_are_not_beside_each_other_are_no_neighbours():
    found = [seeds(each) for each in iterate_triplets(sequence(1, 3, 4, 7), range(1, 8))]
    assert found == [(1, None, None), (3, None, 4), (4, 3, None), (7, None, None)]


@pytest.mark.parametrize("wanted", [[1], [6], [1, 6], [2, 5], [3, 4, 5], list(range(1, 7))])
def test_wanted_frames_have_the_neighbours_that_they_have_in_the_whole_motion(wanted):
    whole = {each.frame: seeds(each) for each in iterate_triplets(sequence(*range(1, 7)), range(1, 7))}
    rolled = add_neighbours(wanted, 1, 6)
    assert rolled == sorted(set(rolled))
    found = [seeds(each) for each in iterate_triplets(sequence(*rolled), wanted)]
    assert found == [whole[frame] for frame in wanted]


def test_neighbours_stay_within_the_motion():
    assert add_neighbours([5, 1, 9], 1, 9) == [1, 2, 4, 5, 6, 8, 9]
    assert add_neighbours([3], 3, 3) == [3]


def test_a_frame_is_yielded_as_soon_as_the_one_after_it_is_made():
    made: list[int] = []
    found = [(each.frame, list(made)) for each in iterate_triplets(sequence(1, 2, 3, made=made), {1, 2, 3})]
    assert found == [(1, [1, 2]), (2, [1, 2, 3]), (3, [1, 2, 3])]


def test_without_neighbours_a_frame_is_yielded_alone_and_at_once():
    made: list[int] = []
    alone = iterate_triplets(sequence(1, 2, 3, made=made), {1, 3}, neighbours=False)
    assert [(seeds(each), list(made)) for each in alone] == [
        ((1, None, None), [1]),
        ((3, None, None), [1, 2, 3]),
    ]


def test_a_single_frame_has_no_neighbours_and_no_frames_are_no_instants():
    assert [seeds(each) for each in iterate_triplets(sequence(4), {4})] == [(4, None, None)]
    assert not list(iterate_triplets(sequence(), {4}))


def test_instants_keep_no_graph_of_what_made_them():
    def produce():
        for number in (1, 2):
            yield some(seed=number).map(Tensor.requires_grad_)

    found = list(iterate_triplets(GaussianSequence((1, 2), 24.0, 6, produce), {1, 2}))
    held = [
        gaussians
        for each in found
        for gaussians in (each.current, each.previous, each.following)
        if gaussians
    ]
    assert len(held) == 4
    assert not any(values.requires_grad for gaussians in held for values in vars(gaussians).values())
