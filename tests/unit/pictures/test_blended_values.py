"""Values blended as colours are: normals, positions, depths, ids."""

import dataclasses
import math

import pytest
import torch
from scenes import joined, layers, some, weighted_sum
from torch.nn.functional import normalize

from dsar.geometry.cameras import project
from dsar.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_axis_angle,
)
from dsar.raster import rasterize
from dsar.types import Gaussians
from dsar_render.blending import blend_values
from dsar_render.picture import render_picture
from dsar_render.settings import RenderSettings
from dsar_render.triplets import FrameTriplet


@pytest.mark.parametrize("channels", range(1, 8))
def test_blended_values_are_the_sum_over_contributors(middle, front, blended, channels):
    generator = torch.Generator().manual_seed(channels)
    offsets = torch.tensor([0.0, 40.0, -40.0, 3.0, -1.0, 0.0, 90.0])[:channels]
    values = torch.randn(len(middle.current), channels, generator=generator) * 10 + offsets
    found, expected = blend_values(middle.current, front, values), weighted_sum(blended, values)
    assert (found - expected).abs().max() < 1e-6 * float(values.abs().max()) * 2
    assert not found[blended.counts == 0].any()


def test_blended_ones_are_alpha(middle, front):
    alpha = rasterize(middle.current, front).alpha
    found = blend_values(middle.current, front, torch.ones(len(middle.current), 1))[..., 0]
    torch.testing.assert_close(found, alpha, atol=1e-6, rtol=0)


def test_values_of_what_is_not_drawn_do_not_matter(middle, front):
    lost = dataclasses.replace(
        some(3), means=torch.tensor([[math.nan] * 3] * 3), harmonics=torch.zeros(3, 1, 3)
    )
    values = torch.randn(len(middle.current), 4, generator=torch.Generator().manual_seed(0))
    strange = torch.tensor([math.nan, math.inf, -math.inf])[:, None].expand(3, 4)
    found = blend_values(joined(middle.current, lost), front, torch.cat([values, strange]))
    torch.testing.assert_close(found, blend_values(middle.current, front, values), atol=1e-6, rtol=0)


def test_no_gaussians_blend_to_nothing(middle, front):
    none = middle.current.map(lambda values: values[:0])
    assert not blend_values(none, front, torch.zeros(0, 4)).any()


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
    normals = render_picture(FrameTriplet(1, disc), still, RenderSettings(("rgba", "N"))).aovs.normals
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
    depth = project(front, middle.current.means)[1]
    ends = blended.counts.flatten().cumsum(0)
    for pixel, (end, count) in enumerate(zip(ends.tolist(), blended.counts.flatten().tolist(), strict=True)):
        nearest, heaviest = 0.0, -1
        if count:
            ids, weights = blended.ids[end - count : end], blended.weights[end - count : end]
            # `argmax` names the first of equals.
            nearest, heaviest = float(depth[ids].min()), int(ids[weights.argmax()])
        assert float(everything.output.first_hit_depth.flatten()[pixel]) == pytest.approx(nearest, abs=2e-6)
        assert int(everything.output.largest_weight_id.flatten()[pixel]) == heaviest


def test_only_what_was_asked_for_is_there(middle, still, labels):
    picture = render_picture(middle, still, RenderSettings(("rgba",)), labels=labels)
    assert set(layers(picture)) == {"color", "alpha", "depth"}
    assert picture.deep is None
    assert picture.output.contributors is None
    assert set(layers(render_picture(middle, still, RenderSettings(("rgba", "N"))))) >= {"normals"}
