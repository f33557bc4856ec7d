"""Gaussians themselves, by our rasteriser, by Mitsuba's rays, and by definition."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
import torch

from dsar.geometry.cameras import project
from dsar.raster import rasterize
from dsar_render.crosscheck.oracle import OURS, STEPS, blend
from dsar_render.crosscheck.splats import (
    GaussianScene,
    closeup,
    correlation_and_slope,
    coverage_difference,
    explain,
    gradients,
    psnr,
    visible_from,
    whiten,
)


@pytest.fixture
def small(oblong):
    return oblong.cropped(40, 30, 36, 32)


def test_the_definition_by_our_choices_is_our_rasteriser(cloud, small):
    drawn = rasterize(cloud, small)
    found = torch.from_numpy(blend(cloud, small, OURS)).float()
    torch.testing.assert_close(found[..., :3], drawn.color, atol=2e-4, rtol=0)
    torch.testing.assert_close(found[..., 3], drawn.alpha, atol=2e-4, rtol=0)


def test_the_definition_by_the_tracers_choices_is_mitsuba(llvm, cloud, small):
    found = blend(cloud, small, STEPS[-1].choices)
    light = GaussianScene(llvm, cloud).trace(small).numpy()
    coverage = GaussianScene(llvm, whiten(cloud)).trace(small).numpy()[..., 0]
    assert np.abs(found[..., :3] - light).mean() < 2e-3
    assert np.abs(found[..., 3] - coverage).mean() < 2e-3


def test_every_choice_changes_something(cloud, small):
    images = [blend(cloud, small, OURS), *(blend(cloud, small, step.choices) for step in STEPS)]
    changes = [np.abs(two - one).mean() for one, two in pairwise(images)]
    assert min(changes) > 1e-5


def test_the_difference_to_mitsuba_is_explained(llvm, cloud, small):
    found = explain(llvm, cloud, small)
    assert [step.name for step in found.steps] == [step.name for step in STEPS]
    assert found.ours < 1e-4
    assert found.theirs < 2e-3
    # The whole difference is many times what is left unexplained.
    whole = rasterize(cloud, small).color.numpy() - GaussianScene(llvm, cloud).trace(small).numpy()
    assert np.abs(whole).mean() > 3 * found.theirs


def test_a_low_pass_does_little_to_large_splats_and_much_to_small_ones(cloud, small):
    without = next(step.choices for step in STEPS if step.name == "low_pass")

    def change(factor: float) -> float:
        sized = dataclasses.replace(cloud, scales=cloud.scales * factor)
        return float(np.abs(blend(sized, small, without) - blend(sized, small, OURS)).mean())

    assert change(0.1) > 3 * change(1.0)


def test_order_makes_no_difference_to_one_gaussian(cloud, small):
    few = cloud.map(lambda values: values[:1])
    before, after = (blend(few, small, step.choices) for step in STEPS[-2:])
    assert np.array_equal(before, after)


def test_distance_does_not_matter(llvm, cloud, oblong):
    """Mitsuba's camera sees as far in metres, whatever unit its scene is in."""
    T = oblong.T_camera_world.clone()
    T[2, 3] += 20.0
    far = dataclasses.replace(oblong, T_camera_world=T)
    view = closeup(cloud, far, 48, 4.0)
    few = visible_from(cloud, view)
    assert GaussianScene(llvm, few).trace(view).max() > 0.3
    assert psnr(rasterize(few, view).color.numpy(), GaussianScene(llvm, few).trace(view).numpy()) > 30


def test_a_camera_that_sees_none_has_no_closeup(cloud, oblong):
    turned = oblong.T_camera_world.clone()
    turned[[0, 2]] *= -1
    assert closeup(cloud, dataclasses.replace(oblong, T_camera_world=turned), 64, 4.0) is None


def test_coverage_and_colours_agree_where_splats_are_some_pixels_large(llvm, cloud, oblong):
    view = closeup(cloud, oblong, 96, 4.0)
    few = visible_from(cloud, view)
    ours = rasterize(few, view)
    theirs = GaussianScene(llvm, few).trace(view)
    covered = GaussianScene(llvm, whiten(few)).trace(view)[..., 0]
    assert coverage_difference(ours.alpha, covered) < 0.005
    assert psnr(ours.color.numpy(), theirs.numpy()) > 30


def test_gradients_agree(llvm, cloud, small):
    # Apart from each other, so that order makes no difference.
    few = cloud.map(lambda values: values[::12])
    few = dataclasses.replace(few, scales=few.scales * 0.7)
    pairs = gradients(llvm, few, small)
    for name, pair in pairs.items():
        correlation, slope = correlation_and_slope(*pair)
        assert correlation > 0.98, name
        assert abs(slope - 1) < 0.08, name


def test_a_closeup_shows_gaussians_as_large_as_asked(cloud, oblong):
    view = closeup(cloud, oblong, 64, 4.0)
    places, depth = project(oblong, cloud.means)
    seen = ((places > 0) & (places < torch.tensor([oblong.width, oblong.height]))).all(-1)
    extent = float(view.K.diagonal()[:2].max()) * cloud.scales.amax(-1) / depth
    assert float(extent[seen].median()) == pytest.approx(4.0, rel=0.02)
    assert (view.width, view.height) == (64, 64)


def test_what_no_ray_meets_is_left_out_and_changes_nothing(cloud, small):
    few = visible_from(cloud, small)
    assert 0 < len(few) < len(cloud)
    torch.testing.assert_close(rasterize(few, small).color, rasterize(cloud, small).color, atol=1e-6, rtol=0)


def test_correlation_and_slope():
    one = torch.tensor([1.0, -2.0, 3.0])
    assert correlation_and_slope(one, 2 * one) == pytest.approx((1.0, 2.0))
    assert correlation_and_slope(one, -one) == pytest.approx((-1.0, -1.0))
    assert correlation_and_slope(torch.tensor([1.0, 0.0]), torch.tensor([0.0, 1.0]))[0] == pytest.approx(0.0)
