"""Pictures: what one camera sees of one frame, and everything else that a file says of its pixels."""

import dataclasses
import math
import re
from itertools import pairwise

import numba
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from dsar.body.model import JOINT_NAMES
from dsar.color import linear_from_srgb, srgb_from_linear
from dsar.errors import ConfigError
from dsar.geometry.cameras import look_at, project
from dsar.geometry.paths import CameraPath
from dsar.geometry.rotations import (
    matrix_from_axis_angle,
    matrix_from_quaternion,
    quaternion_from_axis_angle,
    quaternion_multiply,
)
from dsar.raster import rasterize
from dsar.types import Camera, Contributors, Gaussians, GaussianSequence, Picture
from dsar_render.aovs import AOVS
from dsar_render.blending import blend_values
from dsar_render.deep import sample_deep
from dsar_render.instants import Instant, iterate_instants, with_neighbours
from dsar_render.labels import GARMENT, Labels, label_parts
from dsar_render.picture import RenderSettings, identify, take_picture

MIDDLE = 2
"""Which of the figure's six frames most tests look at."""


@pytest.fixture(scope="module")
def instants(figure: GaussianSequence) -> list[Instant]:
    return list(iterate_instants(figure, figure.frame_numbers))


@pytest.fixture(scope="module")
def middle(instants: list[Instant]) -> Instant:
    return instants[MIDDLE]


@pytest.fixture(scope="module")
def labels(figure: GaussianSequence) -> Labels:
    names, of = label_parts(figure.binding)
    return Labels(names, of.numpy().astype(np.uint8))


@pytest.fixture(scope="module")
def still(front: Camera) -> CameraPath:
    return CameraPath((front,))


@pytest.fixture(scope="module")
def moving(front: Camera) -> CameraPath:
    """A camera that moves, turns and zooms in over the figure's frames, keyed at two of them."""
    K = torch.tensor([[320.0, 0.0, 95.0], [0.0, 320.0, 133.0], [0.0, 0.0, 1.0]])
    end = look_at(np.array([-0.4, 0.5, 2.9]), np.array([0.1, -0.2, 0.0]))
    return CameraPath((front, dataclasses.replace(front, K=K, T_camera_world=end)), (1001, 1006))


@pytest.fixture(scope="module")
def everything(middle: Instant, still: CameraPath, labels: Labels) -> Picture:
    return take_picture(middle, still, RenderSettings(AOVS), labels=labels)


def some(count: int = 6, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(count, 3, generator=generator),
        rotations=normalize(torch.randn(count, 4, generator=generator), dim=-1),
        scales=torch.rand(count, 3, generator=generator) + 0.01,
        opacities=torch.rand(count, generator=generator),
        harmonics=torch.randn(count, 4, 3, generator=generator),
    )


def joined(one: Gaussians, two: Gaussians) -> Gaussians:
    return Gaussians(
        *(torch.cat([a, b]) for a, b in zip(vars(one).values(), vars(two).values(), strict=True))
    )


def moved(gaussians: Gaussians, offset: Tensor) -> Gaussians:
    return dataclasses.replace(gaussians, means=gaussians.means + offset)


def weighted_sum(contributors: Contributors, values: Tensor) -> Tensor:
    """Return the image that the definition of contributors asks for, added up in double precision."""
    counts = contributors.counts.flatten()
    pixels = torch.arange(len(counts)).repeat_interleave(counts)
    shares = contributors.weights.double()[:, None] * values.double()[contributors.ids]
    total = torch.zeros(len(counts), values.shape[1], dtype=torch.float64).index_add_(0, pixels, shares)
    return total.view(*contributors.counts.shape, -1)


def layers(picture: Picture) -> dict[str, Tensor]:
    """Return every image of a picture by name."""
    output, aovs = picture.output, picture.aovs
    found = {
        **{name: getattr(output, name) for name in ("color", "alpha", "depth", "front_depth", "heaviest")},
        **{name: getattr(aovs, name) for name in ("normals", "positions", "forward", "backward")},
        **aovs.coverage,
    }
    return {name: image for name, image in found.items() if image is not None}


# Between frames


@pytest.fixture
def three() -> Instant:
    return Instant(1002, some(seed=1), some(seed=2), some(seed=3))


def test_at_no_offset_the_frame_is_itself(three):
    assert three.at(0.0) is three.now


@pytest.mark.parametrize(("offset", "name"), [(-1.0, "before"), (1.0, "after")])
def test_a_whole_frame_away_is_that_frame(three, offset, name):
    found, expected = three.at(offset), getattr(three, name)
    for field in ("means", "scales", "opacities", "harmonics"):
        assert torch.equal(getattr(found, field), getattr(expected, field))
    # As rotations: a quaternion and its negative are one.
    torch.testing.assert_close(
        matrix_from_quaternion(found.rotations), matrix_from_quaternion(expected.rotations)
    )


@pytest.mark.parametrize("offset", [-0.75, -0.25, 0.125, 0.5])
def test_between_frames_everything_but_rotations_changes_linearly(three, offset):
    other = three.after if offset > 0 else three.before
    found, share = three.at(offset), abs(offset)
    for field in ("means", "scales", "opacities", "harmonics"):
        start, end = getattr(three.now, field), getattr(other, field)
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
    found = Instant(1001, now, after=after)
    torch.testing.assert_close(
        matrix_from_quaternion(found.at(0.5).rotations), matrix_from_quaternion(half), atol=1e-6, rtol=0
    )
    steps = [(found.at(share).rotations * end).sum(-1).abs() for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    assert all((later > earlier).all() for earlier, later in pairwise(steps))


def test_half_a_turn_ends_where_it_should():
    # Quaternions at right angles: neither arc is the shorter one, and their product's sign is 0.
    now, after = (
        dataclasses.replace(some(1), rotations=torch.tensor([rotation]))
        for rotation in ([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0])
    )
    instant = Instant(1001, now, after=after)
    torch.testing.assert_close(instant.at(1.0).rotations.abs(), after.rotations)
    torch.testing.assert_close(
        instant.at(0.5).rotations.abs(), torch.tensor([[math.sqrt(0.5), 0, math.sqrt(0.5), 0]])
    )


@pytest.mark.parametrize(("instant", "offset"), [("first", -0.5), ("last", 0.5), ("last", 1.0)])
def test_beyond_the_ends_of_a_motion_everything_stands_still(instant, offset):
    ends = {"first": Instant(1, some(), after=some(seed=1)), "last": Instant(1, some(), before=some(seed=1))}
    assert ends[instant].at(offset) is ends[instant].now


def sequence(*numbers: int, made: list[int] | None = None) -> GaussianSequence:
    def produce():
        for number in numbers:
            if made is not None:
                made.append(number)
            yield some(seed=number)

    return GaussianSequence(numbers, 24.0, 6, produce)


def seeds(instant: Instant) -> tuple[int, int | None, int | None]:
    """Return the frame and which ones come before and after it, by what they hold."""
    known = {float(some(seed=number).means[0, 0]): number for number in range(1, 12)}

    def which(gaussians: Gaussians | None) -> int | None:
        return None if gaussians is None else known[float(gaussians.means[0, 0])]

    assert which(instant.now) == instant.frame
    return instant.frame, which(instant.before), which(instant.after)


def test_every_frame_comes_with_those_beside_it():
    found = [seeds(each) for each in iterate_instants(sequence(1, 2, 3, 4), range(1, 5))]
    assert found == [(1, None, 2), (2, 1, 3), (3, 2, 4), (4, 3, None)]


def test_frames_that_are_not_beside_each_other_are_no_neighbours():
    found = [seeds(each) for each in iterate_instants(sequence(1, 3, 4, 7), range(1, 8))]
    assert found == [(1, None, None), (3, None, 4), (4, 3, None), (7, None, None)]


@pytest.mark.parametrize("wanted", [[1], [6], [1, 6], [2, 5], [3, 4, 5], list(range(1, 7))])
def test_wanted_frames_have_the_neighbours_that_they_have_in_the_whole_motion(wanted):
    whole = {each.frame: seeds(each) for each in iterate_instants(sequence(*range(1, 7)), range(1, 7))}
    rolled = with_neighbours(wanted, 1, 6)
    assert rolled == sorted(set(rolled))
    found = [seeds(each) for each in iterate_instants(sequence(*rolled), wanted)]
    assert found == [whole[frame] for frame in wanted]


def test_neighbours_stay_within_the_motion():
    assert with_neighbours([5, 1, 9], 1, 9) == [1, 2, 4, 5, 6, 8, 9]
    assert with_neighbours([3], 3, 3) == [3]


def test_a_frame_is_yielded_as_soon_as_the_one_after_it_is_made():
    made: list[int] = []
    found = [(each.frame, list(made)) for each in iterate_instants(sequence(1, 2, 3, made=made), {1, 2, 3})]
    assert found == [(1, [1, 2]), (2, [1, 2, 3]), (3, [1, 2, 3])]


def test_a_single_frame_has_no_neighbours_and_no_frames_are_no_instants():
    assert [seeds(each) for each in iterate_instants(sequence(4), {4})] == [(4, None, None)]
    assert not list(iterate_instants(sequence(), {4}))


def test_instants_keep_no_graph_of_what_made_them():
    def produce():
        for number in (1, 2):
            yield some(seed=number).map(Tensor.requires_grad_)

    found = list(iterate_instants(GaussianSequence((1, 2), 24.0, 6, produce), {1, 2}))
    held = [gaussians for each in found for gaussians in (each.now, each.before, each.after) if gaussians]
    assert len(held) == 4
    assert not any(values.requires_grad for gaussians in held for values in vars(gaussians).values())


# Parts


def binding_of(figure, joints: tuple[str, ...], v: float = 0.5):
    """One Gaussian a joint, which moves it most."""
    count = len(joints)
    weights = 0.6 * torch.eye(count) + 0.4 / count
    return dataclasses.replace(
        figure.binding,
        joint_names=joints,
        weights=weights,
        uv=torch.tensor([[0.5, v]]).expand(count, 2),
        points=torch.zeros(count, 3),
        T_world_rest=torch.eye(4).expand(1, count, 4, 4),
    )


def part_of_each(figure, joints: tuple[str, ...], v: float = 0.5) -> list[str]:
    names, of = label_parts(binding_of(figure, joints, v))
    assert len(set(names)) == len(names)
    return [names[index] for index in of]


def test_parts_of_the_body_have_the_names_that_an_artist_expects(figure):
    expected = {
        "pelvis": "torso",
        "spine1": "torso",
        "spine3": "torso",
        "left_collar": "torso",
        "neck": "head",
        "head": "head",
        "jaw": "head",
        "left_eye_smplhf": "head",
        "left_shoulder": "left_arm",
        "right_elbow": "right_arm",
        "left_wrist": "left_hand",
        "right_index1": "right_hand",
        "left_thumb3": "left_hand",
        "left_hip": "left_leg",
        "right_knee": "right_leg",
        "left_ankle": "left_foot",
        "right_foot": "right_foot",
    }
    assert part_of_each(figure, tuple(expected)) == list(expected.values())


def test_every_joint_of_smplx_belongs_to_one_of_ten_parts(figure):
    sided = [f"{side}_{part}" for side in ("left", "right") for part in ("arm", "hand", "leg", "foot")]
    assert set(part_of_each(figure, JOINT_NAMES)) == {"head", "torso", *sided}


def test_a_joint_of_another_name_is_a_part_of_its_own(figure):
    assert part_of_each(figure, ("pelvis", "tail", "left_wing")) == ["torso", "tail", "left_wing"]


def test_what_lies_below_the_bodys_chart_is_garment(figure):
    assert set(part_of_each(figure, ("head", "left_knee"), v=-0.01)) == {GARMENT}
    assert GARMENT not in part_of_each(figure, ("head", "left_knee"), v=0.0)


def test_left_and_right_hands_are_where_they_are(figure, labels):
    points = figure.binding.points
    middle = {name: points[labels.of == index].mean(0) for index, name in enumerate(labels.names[:-1])}
    assert middle["left_hand"][0] > middle["left_arm"][0] > middle["torso"][0] > middle["right_arm"][0]
    assert middle["right_arm"][0] > middle["right_hand"][0]
    assert middle["head"][1] > middle["torso"][1] > middle["left_leg"][1] > middle["left_foot"][1]


# Blended values


@pytest.fixture(scope="module")
def blended(middle: Instant, front: Camera) -> Contributors:
    found = rasterize(middle.now, front, outputs=["contributors"]).contributors
    assert found is not None
    return found


@pytest.mark.parametrize("channels", range(1, 8))
def test_blended_values_are_the_sum_over_contributors(middle, front, blended, channels):
    generator = torch.Generator().manual_seed(channels)
    offsets = torch.tensor([0.0, 40.0, -40.0, 3.0, -1.0, 0.0, 90.0])[:channels]
    values = torch.randn(len(middle.now), channels, generator=generator) * 10 + offsets
    found, expected = blend_values(middle.now, front, values), weighted_sum(blended, values)
    assert (found - expected).abs().max() < 1e-6 * float(values.abs().max()) * 2
    assert not found[blended.counts == 0].any()


def test_blended_ones_are_alpha(middle, front):
    alpha = rasterize(middle.now, front).alpha
    found = blend_values(middle.now, front, torch.ones(len(middle.now), 1))[..., 0]
    torch.testing.assert_close(found, alpha, atol=1e-6, rtol=0)


def test_values_of_what_is_not_drawn_do_not_matter(middle, front):
    lost = dataclasses.replace(
        some(3), means=torch.tensor([[math.nan] * 3] * 3), harmonics=torch.zeros(3, 1, 3)
    )
    values = torch.randn(len(middle.now), 4, generator=torch.Generator().manual_seed(0))
    strange = torch.tensor([math.nan, math.inf, -math.inf])[:, None].expand(3, 4)
    found = blend_values(joined(middle.now, lost), front, torch.cat([values, strange]))
    torch.testing.assert_close(found, blend_values(middle.now, front, values), atol=1e-6, rtol=0)


def test_no_gaussians_blend_to_nothing(middle, front):
    none = middle.now.map(lambda values: values[:0])
    assert not blend_values(none, front, torch.zeros(0, 4)).any()


# Normals, positions, ids


def test_normals_are_unit_world_and_towards_the_camera(everything, front):
    normals, hit = everything.aovs.normals, everything.output.alpha > 0
    torch.testing.assert_close(normals[hit].norm(dim=-1), torch.ones(int(hit.sum())))
    assert not normals[~hit].any()
    away = normalize(everything.aovs.positions[hit] - front.center, dim=-1)
    # Each Gaussian's faces the camera as seen from its centre, which is not quite the pixel.
    assert ((normals[hit] * away).sum(-1) < 0.05).all()
    assert ((normals[hit] * away).sum(-1) < 0).float().mean() > 0.999


@pytest.mark.parametrize("turned", [False, True], ids=["front", "back"])
def test_the_normal_of_a_disc_is_its_axis_whichever_side_it_shows(front, still, turned):
    rotation = quaternion_from_axis_angle(torch.tensor([0.5, 0.3 + math.pi * turned, 0.0]))[None]
    disc = Gaussians(
        torch.zeros(1, 3), rotation, torch.tensor([[0.2, 0.3, 0.001]]), torch.ones(1), torch.ones(1, 1, 3)
    )
    normals = take_picture(Instant(1, disc), still, RenderSettings(("rgba", "N"))).aovs.normals
    axis = matrix_from_quaternion(rotation)[0, :, 2]
    axis = axis * torch.sign((axis * front.center).sum())
    hit = normals.any(-1)
    assert hit.sum() > 500
    torch.testing.assert_close(normals[hit], axis.expand(int(hit.sum()), 3), atol=1e-5, rtol=0)


def test_positions_lie_behind_their_pixels_centres_at_the_expected_depth(everything, front):
    hit = everything.output.alpha > 0
    y, x = torch.nonzero(hit, as_tuple=True)
    pixels, depth = project(front, everything.aovs.positions[hit].double())
    assert (pixels - torch.stack([x, y], -1) - 0.5).abs().max() < 1e-3
    torch.testing.assert_close(depth.float(), everything.output.depth[hit], atol=1e-6, rtol=1e-6)
    assert not everything.aovs.positions[~hit].any()


def test_front_depth_and_heaviest_are_those_of_the_contributors(everything, middle, front, blended):
    depth = project(front, middle.now.means)[1]
    ends = blended.counts.flatten().cumsum(0)
    for pixel, (end, count) in enumerate(zip(ends.tolist(), blended.counts.flatten().tolist(), strict=True)):
        nearest, heaviest = 0.0, -1
        if count:
            ids, weights = blended.ids[end - count : end], blended.weights[end - count : end]
            # `argmax` names the first of equals.
            nearest, heaviest = float(depth[ids].min()), int(ids[weights.argmax()])
        assert float(everything.output.front_depth.flatten()[pixel]) == pytest.approx(nearest, abs=2e-6)
        assert int(everything.output.heaviest.flatten()[pixel]) == heaviest


def test_only_what_was_asked_for_is_there(middle, still, labels):
    picture = take_picture(middle, still, RenderSettings(("rgba",)), labels=labels)
    assert set(layers(picture)) == {"color", "alpha", "depth"}
    assert picture.deep is None
    assert picture.output.contributors is None
    assert set(layers(take_picture(middle, still, RenderSettings(("rgba", "N"))))) >= {"normals"}


# Motion vectors


def premultiplied(picture: Picture) -> Tensor:
    return torch.cat([picture.output.color, picture.output.alpha[..., None]], -1)


def pulled(image: Tensor, flow: Tensor) -> Tensor:
    """Return an image sampled where each pixel's flow points to."""
    height, width = flow.shape[:2]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    grid = (torch.stack([x, y], -1) + flow) / torch.tensor([width, height]) * 2 - 1
    sampled = grid_sample(image.permute(2, 0, 1)[None], grid[None], mode="bicubic", align_corners=False)
    return sampled[0].permute(1, 2, 0)


def decibels(one: Tensor, two: Tensor) -> float:
    return float(-10 * (one - two).square().mean().log10())


@pytest.mark.parametrize("camera", ["still", "moving"])
def test_motion_vectors_lead_to_the_same_colours_in_the_frames_beside(instants, camera, request):
    path = request.getfixturevalue(camera)
    pictures = [
        take_picture(instants[index], path, RenderSettings(("rgba", "motion")))
        for index in (MIDDLE - 1, MIDDLE, MIDDLE + 1)
    ]
    before, now, after = map(premultiplied, pictures)
    inside = now[..., 3] > 0.99
    assert inside.sum() > 3000
    forward, backward = pictures[1].aovs.forward, pictures[1].aovs.backward
    # 40 dB and more; the frames as they are differ by 15 to 22 dB.
    assert decibels(pulled(after, forward)[inside], now[inside]) > 38
    assert decibels(pulled(before, backward)[inside], now[inside]) > 38
    assert decibels(after[inside], now[inside]) < 25
    # Soft edges, too, where what comes into sight has no place to come from.
    edge = now[..., 3] > 0.5
    floor = 35 if camera == "still" else 31
    assert decibels(pulled(after, forward)[edge], now[edge]) > floor
    assert decibels(pulled(before, backward)[edge], now[edge]) > floor


def slab(front: Camera, gaussians: Gaussians, depth: float) -> Gaussians:
    """Return the Gaussians pushed along their rays onto one plane parallel to the image."""
    scale = depth / project(front, gaussians.means)[1]
    return dataclasses.replace(
        gaussians, means=front.center + (gaussians.means - front.center) * scale[:, None]
    )


def test_what_moves_parallel_to_the_image_moves_by_exactly_the_shift(front, still, middle):
    flat = slab(front, middle.now, 3.0)
    right, down = front.T_camera_world[0, :3], front.T_camera_world[1, :3]
    after, before = moved(flat, 0.03 * right + 0.01 * down), moved(flat, 0.02 * right)
    picture = take_picture(Instant(1002, flat, before, after), still, RenderSettings(("rgba", "motion")))
    hit = picture.output.alpha > 0
    # fx = fy = 300 pixels at 3 m: a hundred pixels a metre.
    for found, shift in ((picture.aovs.forward, [3.0, 1.0]), (picture.aovs.backward, [2.0, 0.0])):
        assert (found[hit] - torch.tensor(shift)).abs().max() < 1e-3
        assert not found[~hit].any()


def test_a_camera_that_goes_with_the_figure_sees_no_motion(front, middle):
    offset = torch.tensor([0.2, -0.1, 0.05])
    transform = front.T_camera_world.clone()
    transform[:3, 3] -= transform[:3, :3] @ offset
    follows = CameraPath((front, dataclasses.replace(front, T_camera_world=transform)), (1002, 1003))
    instant = Instant(1002, middle.now, after=moved(middle.now, offset))
    picture = take_picture(instant, follows, RenderSettings(("motion",)))
    assert picture.aovs.forward.abs().max() < 1e-3


def test_a_still_scene_moves_as_the_camera_does(front, middle):
    """The camera turns: points at any depth move as the rotation says."""
    turn = torch.eye(4)
    turn[:3, :3] = matrix_from_axis_angle(torch.tensor([0.0, 0.02, 0.0]))
    turned = dataclasses.replace(front, T_camera_world=turn @ front.T_camera_world)
    instant = Instant(1002, middle.now, after=middle.now)
    path = CameraPath((front, turned), (1002, 1003))
    picture = take_picture(instant, path, RenderSettings(("rgba", "P", "motion")))
    solid = picture.output.alpha > 0.99
    here, there = (project(camera, picture.aovs.positions[solid])[0] for camera in (front, turned))
    assert (picture.aovs.forward[solid] - (there - here)).abs().max() < 0.05


def test_at_its_ends_a_motion_has_no_vectors(instants, still):
    first, last = (
        take_picture(instants[index], still, RenderSettings(("motion",))).aovs for index in (0, -1)
    )
    assert not first.backward.any()
    assert first.forward.any()
    assert not last.forward.any()
    assert last.backward.any()


@pytest.mark.parametrize(
    "depths", [(1e-4, 1e-4), (0.0, 0.0), (-1e-6, 1.0), (1.0, 1e-6), (0.02, -1.0), (0.0101, 5.0)]
)
def test_what_passes_the_cameras_plane_leaves_other_vectors_alone(front, still, middle, depths):
    forward, right = front.T_camera_world[2, :3], front.T_camera_world[0, :3]

    def with_one(depth: float, side: float) -> Gaussians:
        # Beside the picture, at any depth: 0.3 times its depth is the picture's edge.
        one = middle.now.map(lambda values: values[:1])
        place = front.center + forward * depth + right * side
        return joined(middle.now, dataclasses.replace(one, means=place[None]))

    instant = Instant(1002, with_one(depths[0], 0.9), None, with_one(depths[1], 1.0))
    found = take_picture(instant, still, RenderSettings(("motion",))).aovs.forward
    alone = Instant(1002, middle.now, None, middle.now)
    assert not take_picture(alone, still, RenderSettings(("motion",))).aovs.forward.any()
    # At the faintest edges, whose sums are divided by an alpha of 1/255.
    assert found.abs().max() < 0.02


# Open shutter


def test_the_times_of_a_shutter_lie_evenly_within_it():
    assert RenderSettings().times == [0.0]
    assert RenderSettings(shutter=(-0.25, 0.25)).times == [0.0]
    assert RenderSettings(motion_samples=4, shutter=(0.0, 0.5)).times == [0.0625, 0.1875, 0.3125, 0.4375]
    assert RenderSettings(motion_samples=2, shutter=(-0.5, 0.5)).times == [-0.25, 0.25]


@pytest.mark.parametrize(
    ("settings", "needed"),
    [
        ({}, False),
        ({"shutter": (-0.25, 0.25)}, False),
        ({"aovs": ("rgba", "motion")}, True),
        ({"shutter": (0.0, 0.5)}, True),
        ({"shutter": (-0.25, 0.25), "motion_samples": 2}, True),
    ],
)
def test_neighbours_are_needed_for_motion_and_for_other_times(settings, needed):
    assert RenderSettings(**settings).needs_neighbours == needed


def test_an_open_shutter_does_not_change_a_still_figure(middle, still, labels, everything):
    alike = Instant(middle.frame, middle.now, middle.now, middle.now)
    settings = RenderSettings(AOVS, motion_samples=5, shutter=(-0.5, 0.5))
    found, sharp = layers(take_picture(alike, still, settings, labels=labels)), layers(everything)
    for name in ("color", "alpha", *everything.aovs.coverage):
        torch.testing.assert_close(found[name], sharp[name], atol=2e-6, rtol=1e-5)


def light(color: Tensor, alpha: Tensor) -> np.ndarray:
    """Return premultiplied linear light."""
    coverage = alpha[..., None].double().numpy()
    straight = np.divide(color.double().numpy(), coverage, where=coverage > 0, out=np.zeros(color.shape))
    return linear_from_srgb(straight) * coverage


@pytest.mark.parametrize("shutter", [(-0.25, 0.25), (0.0, 0.5), (-1.0, 1.0)])
@pytest.mark.parametrize("camera", ["still", "moving"])
def test_alpha_and_light_are_means_of_the_moments_pictures(middle, camera, shutter, request):
    path = request.getfixturevalue(camera)
    settings = RenderSettings(("rgba",), motion_samples=3, shutter=shutter)
    found = take_picture(middle, path, settings).output
    moments = [rasterize(middle.at(time), path.at(middle.frame + time)) for time in settings.times]
    alpha = torch.stack([each.alpha.double() for each in moments]).mean(0)
    assert (found.alpha - alpha).abs().max() < 1e-6
    expected = np.mean([light(each.color, each.alpha) for each in moments], 0)
    np.testing.assert_allclose(light(found.color, found.alpha), expected, atol=2e-6)


def test_light_adds_up_not_what_a_display_makes_of_it(front):
    discs = [
        Gaussians(
            torch.zeros(1, 3),
            torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
            torch.full((1, 3), 0.3),
            torch.ones(1),
            torch.full((1, 1, 3), value / 0.28209479),
        )
        for value in (0.5, -0.5)
    ]
    white, black = discs
    settings = RenderSettings(("rgba",), motion_samples=2, shutter=(-1.0, 1.0))
    picture = take_picture(Instant(5, white, white, black), CameraPath((front,)), settings)
    color, alpha = picture.output.color, picture.output.alpha
    place = np.unravel_index(int(alpha.argmax()), alpha.shape)
    # Half a frame before it is white; half a frame later, halfway to black, sRGB .5 or a light of .214.
    expected = srgb_from_linear((1 + linear_from_srgb(np.full(1, 0.5))) / 2)
    assert float(color[place][0] / alpha[place]) == pytest.approx(float(expected[0]), abs=1e-4)


def test_what_is_no_light_stays_sharp_under_an_open_shutter(middle, still, labels, everything):
    settings = RenderSettings(AOVS, motion_samples=2, shutter=(-0.25, 0.25))
    found, sharp = layers(take_picture(middle, still, settings, labels=labels)), layers(everything)
    blurred = {"color", "alpha", *everything.aovs.coverage}
    for name in set(sharp) - blurred:
        assert torch.equal(found[name], sharp[name]), name
    assert not torch.equal(found["alpha"], sharp["alpha"])
    assert not torch.equal(found["left_hand"], sharp["left_hand"])


@pytest.mark.parametrize("settings", [{}, {"motion_samples": 3, "shutter": (-0.25, 0.25)}, {"overscan": 9}])
def test_coverage_of_the_parts_sums_to_alpha(middle, still, labels, settings):
    picture = take_picture(middle, still, RenderSettings(("rgba", "crypto"), **settings), labels=labels)
    shares = torch.stack(list(picture.aovs.coverage.values()))
    assert list(picture.aovs.coverage) == list(labels.names)
    assert (shares >= 0).all()
    torch.testing.assert_close(shares.sum(0), picture.output.alpha, atol=2e-6, rtol=0)
    for name in ("head", "left_foot", "right_hand"):
        assert picture.aovs.coverage[name].max() > 0.5


def test_coverage_is_the_share_of_the_parts_own_gaussians(everything, blended, labels):
    ones = torch.eye(len(labels.names))[torch.from_numpy(labels.of).long()]
    expected = weighted_sum(blended, ones)
    found = torch.stack(list(everything.aovs.coverage.values()), -1)
    assert (found - expected).abs().max() < 1e-6
    # A part that is not in a pixel has no share at all, not even a rounding's: it would fill a matte's rank.
    assert not found[expected == 0].any()


# Overscan


@pytest.mark.parametrize("overscan", [1, 16, 100])
def test_overscan_adds_around_the_picture_and_leaves_it_as_it_is(middle, still, labels, everything, overscan):
    wide = take_picture(middle, still, RenderSettings(AOVS, overscan=overscan), labels=labels)
    assert wide.camera == everything.camera
    assert wide.overscan == overscan
    inside = slice(overscan, -overscan)
    ample = layers(wide)
    for name, image in layers(everything).items():
        assert ample[name].shape[:2] == (256 + 2 * overscan, 192 + 2 * overscan)
        cut = ample[name][inside, inside]
        if image.dtype == torch.int64:
            assert torch.equal(cut, image), name
        else:
            # Not to the bit: pixels have other coordinates.
            assert (cut - image).abs().max() < 3e-4, name
    assert (ample["color"][inside, inside] - everything.output.color).abs().max() < 1e-5


def test_overscan_shows_what_lies_beyond_the_picture(middle, front):
    close = CameraPath((dataclasses.replace(front.cropped(60, 60, 64, 64), name="close"),))
    picture = take_picture(middle, close, RenderSettings(("rgba",), overscan=60))
    whole = take_picture(middle, CameraPath((front,)), RenderSettings(("rgba",)))
    torch.testing.assert_close(picture.output.alpha, whole.output.alpha[:184, :184], atol=1e-4, rtol=0)


# Settings


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"aovs": ()}, "--aov: expected some of rgba, alpha, Z, N, P, motion, id, crypto, found none"),
        ({"aovs": ("rgba", "depth", "uv")}, "found depth, uv"),
        ({"shutter": (0.25, -0.25)}, "opening and closing times from -1 to 1 frames, found 0.25 -0.25"),
        ({"shutter": (-1.5, 0.0)}, "--shutter: expected"),
        ({"shutter": (0.0, 1.01)}, "--shutter: expected"),
        ({"shutter": (math.nan, 0.5)}, "--shutter: expected"),
        ({"motion_samples": 0}, "--motion-samples and --deep-max-samples start at 1"),
        ({"deep_max_samples": 0}, "found 1, 0 and 0"),
        ({"overscan": -1}, "--overscan at 0; found 1, 32 and -1"),
        ({"motion_samples": 2}, "the shutter is never open"),
        ({"deep": True, "motion_samples": 2, "shutter": (-0.25, 0.25)}, "leave --motion-samples out"),
        # One picture, but not of the frame's own time, at which the samples are.
        (
            {"deep": True, "shutter": (0.0, 0.5)},
            "--shutter 0 0.5 takes the image at 0.25; leave --shutter out",
        ),
    ],
)
def test_settings_that_contradict_each_other_are_refused(settings, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        RenderSettings(**settings)


def test_deep_goes_with_a_shutter_that_opens_around_the_frame():
    assert RenderSettings(deep=True, shutter=(-0.25, 0.25)).times == [0.0]


# Identity

PROVENANCE = {"checkpoint": "abc", "motion": "walk", "motion_hash": "12"}


def named(front: Camera, **changes) -> str:
    arguments = {
        "frame": 1003,
        "path": CameraPath((front,)),
        "settings": RenderSettings(("rgba", "Z")),
        "provenance": PROVENANCE,
        "writer": "exr",
    }
    return identify(**(arguments | changes))


def test_a_job_is_the_same_however_it_is_told(front):
    copy = dataclasses.replace(front, K=front.K.clone(), T_camera_world=front.T_camera_world.clone())
    again = named(
        copy, settings=RenderSettings(("rgba", "Z")), provenance=dict(reversed(list(PROVENANCE.items())))
    )
    assert again == named(front)
    assert len(again) == 32
    # Keys that say nothing new are no other path.
    assert named(front, path=CameraPath((front,) * 5, tuple(range(1001, 1006)))) == named(front)


def test_a_job_depends_on_everything_that_its_file_depends_on(front, moving):
    shifted, zoomed = front.T_camera_world.clone(), front.K.clone()
    shifted[0, 3] += 1e-6
    zoomed[0, 0] += 1e-4
    cameras = [
        dataclasses.replace(front, T_camera_world=shifted),
        dataclasses.replace(front, K=zoomed),
        dataclasses.replace(front, width=191),
        dataclasses.replace(front, height=255),
        dataclasses.replace(front, name="back"),
    ]
    # Where it is beside the frame makes motion vectors and blur.
    later = CameraPath((front, front, cameras[0]), (1000, 1003, 1004))
    earlier = CameraPath((cameras[0], front, front), (1002, 1003, 1004))
    settings = [
        {"aovs": ("rgba",)},
        {"aovs": ("Z", "rgba")},
        {"deep": True},
        {"deep_max_samples": 31},
        {"overscan": 1},
        {"shutter": (-0.25, 0.25)},
        {"shutter": (-0.25, 0.25), "motion_samples": 2},
    ]
    jobs = [
        named(front),
        named(front, frame=1004),
        named(front, path=moving),
        named(front, path=later),
        named(front, path=earlier),
        *(named(front, path=CameraPath((camera,))) for camera in cameras),
        *(named(front, settings=RenderSettings(**({"aovs": ("rgba", "Z")} | each))) for each in settings),
        *(named(front, provenance=PROVENANCE | {key: "other"}) for key in PROVENANCE),
        named(front, provenance=PROVENANCE | {"new": "abc"}),
        named(front, provenance={}),
        named(front, writer="png"),
    ]
    assert len(set(jobs)) == len(jobs)


def test_a_job_depends_on_the_version(front, monkeypatch):
    before = named(front)
    monkeypatch.setattr("dsar_render.picture._version", lambda: "9.9")
    assert named(front) != before


# The same everywhere


@pytest.mark.parametrize("settings", [{"deep": True}, {"motion_samples": 2, "shutter": (-0.25, 0.25)}])
def test_a_picture_does_not_depend_on_the_number_of_threads(middle, moving, labels, settings):
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one processor")
    before = numba.get_num_threads()
    pictures = []
    try:
        for threads in (1, numba.config.NUMBA_NUM_THREADS):
            numba.set_num_threads(threads)
            pictures.append(take_picture(middle, moving, RenderSettings(AOVS, **settings), labels=labels))
    finally:
        numba.set_num_threads(before)
    one, many = map(layers, pictures)
    assert all(torch.equal(one[name], many[name]) for name in one)
    if settings.get("deep"):
        deep = [vars(picture.deep) for picture in pictures]
        assert all(torch.equal(deep[0][name], deep[1][name]) for name in deep[0])


def test_a_picture_does_not_change_what_it_is_made_of(middle, still, labels):
    before = [values.clone() for values in vars(middle.now).values()]
    take_picture(middle, still, RenderSettings(AOVS, deep=True), labels=labels)
    assert all(map(torch.equal, before, vars(middle.now).values()))


def test_everything_follows_when_scene_and_camera_move_together(middle, moving, labels):
    turn, offset = torch.tensor([0.4, -0.8, 0.3]), torch.tensor([0.5, 1.5, -0.7])
    rotation, quaternion = matrix_from_axis_angle(turn), quaternion_from_axis_angle(turn)

    def carried(gaussians: Gaussians) -> Gaussians:
        rotations = quaternion_multiply(quaternion.expand(len(gaussians), 4), gaussians.rotations)
        return dataclasses.replace(
            gaussians, means=gaussians.means @ rotation.T + offset, rotations=rotations
        )

    def followed(camera: Camera) -> Camera:
        T_world_new = torch.eye(4, dtype=torch.float64)
        T_world_new[:3, :3], T_world_new[:3, 3] = rotation.T, -rotation.T @ offset
        return dataclasses.replace(
            camera, T_camera_world=(camera.T_camera_world.double() @ T_world_new).float()
        )

    elsewhere = Instant(middle.frame, *map(carried, (middle.now, middle.before, middle.after)))
    path = dataclasses.replace(moving, cameras=tuple(map(followed, moving.cameras)))
    here = take_picture(middle, moving, RenderSettings(AOVS), labels=labels)
    there = take_picture(elsewhere, path, RenderSettings(AOVS), labels=labels)
    expected, found = layers(here), layers(there)
    hit = (here.output.alpha > 0.02) & (there.output.alpha > 0.02)
    expected["normals"] = expected["normals"] @ rotation.T
    expected["positions"] = expected["positions"] @ rotation.T + offset
    for name, image in expected.items():
        if name == "heaviest":
            # Of two equal shares rounding makes either the larger.
            assert (image == found[name])[hit].float().mean() > 0.999
            continue
        difference = (found[name] - image)[hit].abs().flatten().sort().values
        assert difference[int(0.999 * (len(difference) - 1))] < 1e-4, name
        # Whether a fragment of just 1/255 is drawn hangs on the last digit.
        assert difference[-1] < 0.02, name


# Deep samples


@pytest.mark.parametrize("most", [1, 2, 4, 32])
def test_deep_samples_flatten_to_the_picture(middle, front, most):
    output = rasterize(middle.now, front, outputs=["contributors"])
    deep = sample_deep(output, middle.now, front, max_samples=most)
    counts = deep.counts.flatten()
    assert int(counts.max()) <= most
    assert torch.equal(deep.counts > 0, output.alpha > 0)
    assert int(counts.sum()) == len(deep.alphas) == len(deep.colors) == len(deep.depths) == len(deep.ids)
    color, alpha = (
        torch.zeros(len(counts), 3, dtype=torch.float64),
        torch.zeros(len(counts), dtype=torch.float64),
    )
    starts = counts.cumsum(0) - counts
    for place in range(int(counts.max())):
        there = counts > place
        index = starts[there] + place
        share = deep.alphas[index].double() * (1 - alpha[there])
        color[there] += share[:, None] * deep.colors[index]
        alpha[there] += share
    assert (alpha.view(256, 192) - output.alpha).abs().max() < 1e-5
    assert (color.view(256, 192, 3) - output.color).abs().max() < 1e-5


@pytest.mark.parametrize("most", [1, 3, 32])
def test_merged_samples_are_in_order_within_what_they_stand_for(middle, front, blended, most):
    output = rasterize(middle.now, front, outputs=["contributors"])
    deep = sample_deep(output, middle.now, front, max_samples=most)
    depth = project(front, middle.now.means)[1]
    ends, stops = deep.counts.flatten().cumsum(0), blended.counts.flatten().cumsum(0)
    for pixel in torch.nonzero(deep.counts.flatten()).flatten()[::37].tolist():
        merged = slice(int(ends[pixel] - deep.counts.flatten()[pixel]), int(ends[pixel]))
        whole = slice(int(stops[pixel] - blended.counts.flatten()[pixel]), int(stops[pixel]))
        z, ids = deep.depths[merged], blended.ids[whole]
        assert (z.diff() >= 0).all()
        assert float(z.min()) >= float(depth[ids].min()) - 1e-5
        assert float(z.max()) <= float(depth[ids].max()) + 1e-5
        assert set(deep.ids[merged].tolist()) <= set(ids.tolist())
        if len(ids) <= most:
            assert torch.equal(deep.ids[merged], ids)
        else:
            # The heaviest of all is the heaviest of its sample.
            assert int(ids[blended.weights[whole].argmax()]) in deep.ids[merged].tolist()


def test_depths_never_fall_where_rounding_would_have_them_fall(middle, front):
    # All on one plane but for their last digits, which the rasteriser rounds in its own way.
    flat = slab(front, middle.now, 3.0)
    output = rasterize(flat, front, outputs=["contributors"])
    own = project(front, flat.means)[1][output.contributors.ids].diff()
    assert (own < 0).any()
    for most in (3, 10**6):
        deep = sample_deep(output, flat, front, max_samples=most)
        within = torch.arange(deep.counts.numel()).repeat_interleave(deep.counts.flatten()).diff() == 0
        assert (deep.depths.diff()[within] >= 0).all()


def test_a_picture_of_nothing_is_empty(middle, front, labels):
    away = dataclasses.replace(front, T_camera_world=look_at(np.array([0, 0, 5.0]), np.array([0, 0, 9.0])))
    picture = take_picture(middle, CameraPath((away,)), RenderSettings(AOVS, deep=True), labels=labels)
    assert not any(image.any() for name, image in layers(picture).items() if name != "heaviest")
    assert (picture.output.heaviest == -1).all()
    assert not picture.deep.counts.any()
    assert len(picture.deep.alphas) == 0
