"""Where each pixel comes from and goes to."""

import dataclasses

import pytest
import torch
from scenes import MIDDLE, joined, moved, slab
from torch import Tensor
from torch.nn.functional import grid_sample

from dsar.geometry.camera_paths import CameraPath
from dsar.geometry.cameras import project
from dsar.geometry.rotations import (
    matrix_from_axis_angle,
)
from dsar.types import Gaussians, Picture
from dsar_render.picture import render_picture
from dsar_render.settings import RenderSettings
from dsar_render.triplets import FrameTriplet


def premultiplied(picture: Picture) -> Tensor:
    return torch.cat([picture.output.color, picture.output.alpha[..., None]], -1)


def pulled(image: Tensor, flow: Tensor) -> Tensor:
    """Return an image sampled where each pixel's flow points to."""
    height, width = flow.shape[:2]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    grid = (torch.stack([x, y], -1) + flow) / torch.tensor([width, height]) * 2 - 1
    sampled = grid_sample(image.permute(2, 0, 1)[None], grid[None], mode="bicubic", align_corners=False)
    return sampled[0].permute(1, 2, 0)


def returns(flow: Tensor, back: Tensor) -> Tensor:
    """Return where the way to the other frame and back ends within a tenth of a pixel of where it began."""
    return (flow + pulled(back, flow)).norm(dim=-1) < 0.1


def decibels(one: Tensor, two: Tensor) -> float:
    return float(-10 * (one - two).square().mean().log10())


@pytest.mark.parametrize("camera", ["still", "moving"])
def test_motion_vectors_lead_to_the_same_colours_in_the_frames_beside(instants, camera, request):
    path = request.getfixturevalue(camera)
    pictures = [
        render_picture(instants[index], path, RenderSettings(("rgba", "motion")))
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
    # Soft edges, too, but for what is out of sight in the other frame: there the way back leads elsewhere.
    edge = now[..., 3] > 0.5
    there, back = (
        edge & returns(forward, pictures[2].aovs.backward),
        edge & returns(backward, pictures[0].aovs.forward),
    )
    assert min(there.sum(), back.sum()) > 0.9 * edge.sum()
    assert decibels(pulled(after, forward)[there], now[there]) > 35
    assert decibels(pulled(before, backward)[back], now[back]) > 35


def test_what_moves_parallel_to_the_image_moves_by_exactly_the_shift(front, still, middle):
    flat = slab(front, middle.current, 3.0)
    right, down = front.T_camera_world[0, :3], front.T_camera_world[1, :3]
    after, before = moved(flat, 0.03 * right + 0.01 * down), moved(flat, 0.02 * right)
    picture = render_picture(
        FrameTriplet(1002, flat, before, after), still, RenderSettings(("rgba", "motion"))
    )
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
    triplet = FrameTriplet(1002, middle.current, following=moved(middle.current, offset))
    picture = render_picture(triplet, follows, RenderSettings(("motion",)))
    assert picture.aovs.forward.abs().max() < 1e-3


def test_a_still_scene_moves_as_the_camera_does(front, middle):
    """The camera turns: points at any depth move as the rotation says."""
    turn = torch.eye(4)
    turn[:3, :3] = matrix_from_axis_angle(torch.tensor([0.0, 0.02, 0.0]))
    turned = dataclasses.replace(front, T_camera_world=turn @ front.T_camera_world)
    triplet = FrameTriplet(1002, middle.current, following=middle.current)
    path = CameraPath((front, turned), (1002, 1003))
    picture = render_picture(triplet, path, RenderSettings(("rgba", "P", "motion")))
    solid = picture.output.alpha > 0.99
    here, there = (project(camera, picture.aovs.positions[solid])[0] for camera in (front, turned))
    assert (picture.aovs.forward[solid] - (there - here)).abs().max() < 0.05


def test_at_its_ends_a_motion_has_no_vectors(instants, still):
    first, last = (
        render_picture(instants[index], still, RenderSettings(("motion",))).aovs for index in (0, -1)
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
        one = middle.current.map(lambda values: values[:1])
        place = front.center + forward * depth + right * side
        return joined(middle.current, dataclasses.replace(one, means=place[None]))

    triplet = FrameTriplet(1002, with_one(depths[0], 0.9), None, with_one(depths[1], 1.0))
    found = render_picture(triplet, still, RenderSettings(("motion",))).aovs.forward
    alone = FrameTriplet(1002, middle.current, None, middle.current)
    assert not render_picture(alone, still, RenderSettings(("motion",))).aovs.forward.any()
    # At the faintest edges, whose sums are divided by an alpha of 1/255.
    assert found.abs().max() < 0.02
