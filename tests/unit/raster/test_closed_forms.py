"""Images that are known in closed form, by every backend."""

import math

import pytest
import torch
from raster_scenes import (
    BACKENDS,
    EXTRAS,
    SCENES,
    concatenate,
    draw,
    make_camera,
    make_gaussians,
    one_gaussian,
)
from torch import Tensor

from dsar.geometry.harmonics import C0
from dsar.raster import rasterize, reduced_dilation


@pytest.mark.parametrize("backend", BACKENDS)
def test_isotropic_gaussian_has_the_closed_form_image(backend):
    camera = make_camera(off_center=(0.0, 0.0))
    gaussians = one_gaussian(harmonics=(torch.tensor([[[0.9, 0.4, 0.1]]]) - 0.5) / C0)
    output = draw(gaussians, camera, backend)
    y, x = torch.meshgrid(torch.arange(37) + 0.5, torch.arange(53) + 0.5, indexing="ij")
    # sigma of 0.1 m at 2 m through focal lengths 60 and 66, plus the dilation of 0.3 pixels².
    exponent = (x - 26.5) ** 2 / (3.0**2 + 0.3) + (y - 18.5) ** 2 / (3.3**2 + 0.3)
    alpha = 0.8 * torch.exp(-0.5 * exponent)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0)
    assert torch.allclose(output.alpha, alpha, atol=2e-6)
    assert torch.allclose(output.color, alpha[..., None] * torch.tensor([0.9, 0.4, 0.1]), atol=2e-6)
    assert torch.allclose(output.depth, torch.where(alpha > 0, 2.0, 0.0), atol=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_gaussians_at_one_depth_show_that_depth(backend):
    gaussians = make_gaussians(200).map(torch.Tensor.float)
    gaussians.means[:, 2] = 1.25
    output = draw(gaussians, make_camera(), backend)
    hit = output.alpha > 0
    assert 0.1 < hit.float().mean() < 1
    assert torch.allclose(output.depth[hit], torch.tensor(1.25), atol=1e-4)
    assert (output.depth[~hit] == 0).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_background_shows_through_what_transmittance_is_left(backend):
    gaussians, background = make_gaussians(100).map(torch.Tensor.float), torch.tensor([0.1, 0.5, 0.9])
    bare = draw(gaussians, make_camera(), backend)
    over = draw(gaussians, make_camera(), backend, background)
    expected = bare.color + (1 - bare.alpha)[..., None] * background
    assert torch.allclose(over.color, expected, atol=1e-6)
    assert torch.equal(over.alpha, bare.alpha)


@pytest.mark.parametrize("backend", BACKENDS)
def test_distant_splats_keep_their_light_when_antialiased(backend):
    """Else dilation makes a splat much smaller than a pixel as large as one, and as opaque as before."""
    camera = make_camera(off_center=(0.0, 0.0))
    gaussian = one_gaussian(scales=torch.full((1, 3), 0.01))
    # sigma of 0.3 and 0.33 pixels; the light of a splat is 2 pi opacity sigma_x sigma_y.
    light = 2 * math.pi * 0.8 * 0.3 * 0.33
    smooth = draw(gaussian, camera, backend, antialiased=True, dilation=0.5).alpha.sum()
    # The rim below 1/255 is lost.
    assert 0.95 < smooth / light < 1
    assert draw(gaussian, camera, backend, dilation=0.5).alpha.sum() > 5 * light


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("scene", ["random", "saturated", "empty"])
def test_the_first_and_the_heaviest_gaussian_are_those_of_the_list(backend, scene):
    gaussians = SCENES[scene].map(Tensor.float)
    output = draw(gaussians, make_camera(), backend, outputs=EXTRAS)
    counts, ids, weights = (getattr(output.contributors, name) for name in ("counts", "ids", "weights"))
    for pixel, (shares, mine) in enumerate(
        zip(weights.split(counts.flatten().tolist()), ids.split(counts.flatten().tolist()), strict=True)
    ):
        heaviest, front = output.largest_weight_id.flatten()[pixel], output.first_hit_depth.flatten()[pixel]
        assert heaviest == (mine[shares.argmax()] if len(mine) else -1)
        assert front == pytest.approx(float(gaussians.means[mine[0], 2]) if len(mine) else 0.0, abs=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_median_depth_is_where_half_of_the_light_is_gone(backend):
    """Three sheets of opacity .4: .6 of the light passes the first, .36 the second."""
    sheets = [
        one_gaussian(
            means=torch.tensor([[0.0, 0.0, z]]),
            scales=torch.full((1, 3), 50.0),
            opacities=torch.tensor([0.4]),
        )
        for z in (3.0, 2.0, 1.0)
    ]
    camera = make_camera(off_center=(0.0, 0.0))
    output = draw(concatenate(*sheets), camera, backend, outputs=["median_depth"])
    assert (output.median_depth == 2.0).all()
    assert output.contributors is None
    faint = draw(sheets[0], camera, backend, outputs=["median_depth"])
    assert (faint.median_depth == 3.0).all()
    assert draw(sheets[0], camera, backend).median_depth is None


def test_opaque_wall_hides_what_is_behind_it_exactly():
    walls = [one_gaussian(scales=torch.full((1, 3), 5.0), opacities=torch.ones(1)) for _ in range(3)]
    hidden = one_gaussian(means=torch.tensor([[0.0, 0.0, 3.0]]), harmonics=torch.full((1, 1, 3), 5.0))
    camera = make_camera(off_center=(0.0, 0.0))
    with_hidden = rasterize(concatenate(*walls, hidden), camera)
    assert torch.equal(with_hidden.color, rasterize(concatenate(*walls), camera).color)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_small_image_equals_block_averages_of_the_large_one(backend):
    """Else Gaussians that were fitted to small images come out too thin for large ones."""
    camera = make_camera(96, 64, 120.0)
    gaussians = make_gaussians(30, size=0.03, opacity=(0.2, 0.6))
    if backend != "reference":
        gaussians = gaussians.map(Tensor.float)
    large = draw(gaussians, camera, backend).alpha
    averages = torch.nn.functional.avg_pool2d(large[None, None], 2)[0, 0]
    small = camera.resized(48, 32)
    matched = draw(gaussians, small, backend, dilation=reduced_dilation(2)).alpha
    usual = draw(gaussians, small, backend).alpha
    # What is left: the peak of a splat as thin as a pixel, which averaging lowers and dilation does not.
    assert (matched - averages).abs().max() < 0.1
    assert (matched - averages).abs().mean() < 0.4 * (usual - averages).abs().mean()
