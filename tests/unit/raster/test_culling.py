"""What is left out of an image, and what is refused."""

import dataclasses
import inspect
import math

import pytest
import torch
from raster_scenes import (
    BACKENDS,
    FIELDS,
    broken_gaussians,
    concatenate,
    draw,
    make_camera,
    make_gaussians,
    one_gaussian,
    render_with_gradients,
)

from dsar.errors import CaptureError, ConfigError, RasterError
from dsar.raster import backends, cpu, rasterize
from dsar.raster.checks import check_outputs


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", broken_gaussians())
def test_what_cannot_be_drawn_leaves_background_and_zero_gradients(backend, name):
    images, gradients = render_with_gradients(broken_gaussians()[name], make_camera(), backend, torch.float32)
    assert torch.equal(images["color"], torch.tensor([0.2, 0.5, 0.9]).expand(37, 53, 3))
    assert not images["alpha"].any()
    assert not images["depth"].any()
    assert not any(gradients[field].any() for field in FIELDS)


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_left_out_is_counted(backend):
    broken = concatenate(*broken_gaussians().values())
    good = make_gaussians(50, spread=0.2).map(torch.Tensor.float)
    assert draw(concatenate(good, broken), make_camera(), backend).culled == len(broken)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_rotation_whose_square_overflows_is_left_out(backend):
    """Else its inverse norm is 0, and it is drawn as if it were not turned."""
    assert draw(one_gaussian(rotations=torch.full((1, 4), 1e20)), make_camera(), backend).culled == 1


def test_a_list_of_tiles_that_would_not_fit_is_refused(monkeypatch):
    monkeypatch.setattr(cpu, "_MAX_PAIRS", 11)
    wall = one_gaussian(scales=torch.full((1, 3), 50.0))
    with pytest.raises(RasterError, match="1 Gaussians cover 12 tiles"):
        rasterize(wall, make_camera())


def test_inputs_that_do_not_fit_are_refused():
    gaussians, camera = one_gaussian(), make_camera()
    skewed = camera.K.clone()
    skewed[0, 1] = 2.0
    with pytest.raises(CaptureError, match="fx, fy > 0"):
        rasterize(gaussians, dataclasses.replace(camera, K=skewed))
    with pytest.raises(CaptureError, match="not finite"):
        rasterize(gaussians, dataclasses.replace(camera, T_camera_world=camera.T_camera_world * math.nan))
    with pytest.raises(ConfigError, match="dilation must be positive"):
        rasterize(gaussians, camera, dilation=0.0)
    with pytest.raises(CaptureError, match="0 x 37 pixels"):
        rasterize(gaussians, dataclasses.replace(camera, width=0))
    with pytest.raises(ConfigError, match="not 3"):
        rasterize(one_gaussian(harmonics=torch.zeros(1, 3, 3)), camera)
    with pytest.raises(ConfigError, match="float32 tensors in main memory"):
        rasterize(gaussians.map(torch.Tensor.double), camera, backend="cpu")
    with pytest.raises(ConfigError, match="tensors differ"):
        rasterize(dataclasses.replace(gaussians, means=gaussians.means.double()), camera)
    with pytest.raises(ConfigError, match="no camera gradients"):
        rasterize(gaussians, dataclasses.replace(camera, K=camera.K.clone().requires_grad_()))
    with pytest.raises(
        ConfigError,
        match="outputs can be median_depth, first_hit_depth, largest_weight_id, contributors; found normals",
    ):
        check_outputs(["normals"])
    with pytest.raises(ConfigError, match="backend can be auto, cpu, warp, gsplat, reference; found cuda"):
        # Past the check of types, which only tests have.
        inspect.unwrap(backends._choose_backend)("cuda", gaussians.means, [[camera]])
    with pytest.raises(ConfigError, match="float32 tensors on a GPU, not"):
        rasterize(gaussians, camera, backend="gsplat")
