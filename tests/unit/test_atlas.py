"""Texels lie where their UV triangle says, weights stay weights, and cells find their texels."""

import dataclasses

import pytest
import torch

from dsar.avatar.bilinear import bilinear_sampling, sample_bilinear
from dsar.avatar.charts import Atlas, Chart, body_chart
from dsar.avatar.control_grid import assign_control_cells
from dsar.body.files import load_body
from dsar.body.uv_map import rasterize_uv, smooth_weights
from dsar.errors import BodyError


@pytest.fixture(scope="module")
def body():
    return load_body()


def test_barycentrics_reproduce_the_texel_centre(body):
    resolution = 64
    faces, barycentrics = rasterize_uv(body, resolution)
    covered = faces >= 0
    uv = torch.einsum("nk,nkc->nc", barycentrics[covered], body.uv[body.uv_faces[faces[covered]]])
    row, column = covered.nonzero().unbind(1)
    centers = torch.stack([(column + 0.5) / resolution, 1 - (row + 0.5) / resolution], -1)
    assert torch.allclose(uv, centers, atol=1e-6)
    assert barycentrics[covered].min() >= -1e-8


def test_charts_stack_without_mixing(body):
    chart = body_chart(body, 32)
    atlas = Atlas.stack([chart, chart])
    count = int(chart.covered.sum())
    assert (atlas.height, atlas.width, len(atlas)) == (64, 32, 2 * count)
    assert torch.equal(atlas.texels[count:], atlas.texels[:count] + 32 * 32)
    assert torch.allclose(atlas.weights.sum(1), torch.ones(2 * count), atol=1e-5)


def test_smoothed_weights_still_sum_to_one_and_are_smoother(body):
    smooth = smooth_weights(body, 10)
    assert torch.allclose(smooth.sum(1), torch.ones(len(smooth)), atol=1e-5)

    def roughness(weights):
        return (weights[body.faces[:, 0]] - weights[body.faces[:, 1]]).square().sum()

    assert roughness(smooth) < 0.5 * roughness(body.weights)


def test_uv_outside_the_square_is_refused(body):
    outside = dataclasses.replace(body, uv=body.uv + 5)
    with pytest.raises(BodyError, match="UV map"):
        body_chart(outside, 16)


def test_every_occupied_cell_holds_a_texel_of_its_own(body):
    atlas = Atlas.stack([body_chart(body, 64)])
    cells, nearest = assign_control_cells(atlas, 4)
    texel = atlas.texels[nearest]
    assert torch.equal(texel // 64 // 4 * 16 + texel % 64 // 4, cells)
    assert len(cells.unique()) == len(cells)
    assert set((atlas.texels // 64 // 4 * 16 + atlas.texels % 64 // 4).tolist()) == set(cells.tolist())


def test_texels_are_sampled_as_bilinear_interpolation_does():
    maps = torch.randn(2, 3, 6, 4, generator=torch.Generator().manual_seed(0))
    rows, columns = (
        grid.flatten() for grid in torch.meshgrid(torch.arange(24), torch.arange(16), indexing="ij")
    )
    expected = torch.nn.functional.interpolate(maps, size=(24, 16), mode="bilinear")
    sampled = sample_bilinear(
        maps, bilinear_sampling(rows, columns, 4, 4, [Chart("body", "island", range(24))])
    )
    assert torch.allclose(sampled.mT.reshape(2, 3, 24, 16), expected, atol=1e-6)


def test_a_garments_texels_are_sampled_round_its_tube_and_off_the_body():
    maps = torch.randn(2, 3, 6, 4, generator=torch.Generator().manual_seed(0))
    rows, columns = (
        grid.flatten() for grid in torch.meshgrid(torch.arange(24), torch.arange(16), indexing="ij")
    )
    charts = [Chart("body", "island", range(16)), Chart("garment", "tube", range(16, 24))]
    sampled = sample_bilinear(maps, bilinear_sampling(rows, columns, 4, 4, charts)).mT.reshape(2, 3, 24, 16)
    body, tube = (
        torch.nn.functional.interpolate(part, scale_factor=4, mode="bilinear")
        for part in (maps[:, :, :4], maps[:, :, 4:].repeat(1, 1, 1, 3))
    )
    assert torch.allclose(sampled[:, :, :16], body, atol=1e-6)
    assert torch.allclose(sampled[:, :, 16:], tube[..., 16:32], atol=1e-6)


def test_surface_frames_are_right_handed_and_point_outwards_and_up(body):
    chart = body_chart(body, 64)
    identity = torch.eye(3).expand(len(chart.frames), 3, 3)
    assert torch.allclose(chart.frames.mT @ chart.frames, identity, atol=1e-5)
    assert torch.allclose(torch.linalg.det(chart.frames), torch.ones(len(chart.frames)), atol=1e-5)
    normals, up = chart.frames[..., 2], chart.frames[..., 1]
    assert (up[normals[:, 1].abs() < 0.9, 1] > 0.4).all()
    chest = (chart.positions - torch.tensor([0.0, 0.45, 0.15])).norm(dim=1).argmin()
    assert normals[chest, 2] > 0.7
