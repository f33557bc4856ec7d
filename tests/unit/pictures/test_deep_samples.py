"""Samples at their depths."""

import dataclasses

import numpy as np
import pytest
import torch
from scenes import layers, slab

from dsar.geometry.camera_paths import CameraPath
from dsar.geometry.cameras import look_at, project
from dsar.raster import rasterize
from dsar_render.aovs import AOVS
from dsar_render.deep import sample_deep
from dsar_render.picture import render_picture
from dsar_render.settings import RenderSettings


@pytest.mark.parametrize("most", [1, 2, 4, 32])
def test_deep_samples_flatten_to_the_picture(middle, front, most):
    output = rasterize(middle.current, front, outputs=["contributors"])
    deep = sample_deep(output, middle.current, front, max_samples=most)
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
    output = rasterize(middle.current, front, outputs=["contributors"])
    deep = sample_deep(output, middle.current, front, max_samples=most)
    depth = project(front, middle.current.means)[1]
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
    flat = slab(front, middle.current, 3.0)
    output = rasterize(flat, front, outputs=["contributors"])
    own = project(front, flat.means)[1][output.contributors.ids].diff()
    assert (own < 0).any()
    for most in (3, 10**6):
        deep = sample_deep(output, flat, front, max_samples=most)
        within = torch.arange(deep.counts.numel()).repeat_interleave(deep.counts.flatten()).diff() == 0
        assert (deep.depths.diff()[within] >= 0).all()


def test_a_picture_of_nothing_is_empty(middle, front, labels):
    away = dataclasses.replace(front, T_camera_world=look_at(np.array([0, 0, 5.0]), np.array([0, 0, 9.0])))
    picture = render_picture(middle, CameraPath((away,)), RenderSettings(AOVS, deep=True), labels=labels)
    assert not any(image.any() for name, image in layers(picture).items() if name != "largest_weight_id")
    assert (picture.output.largest_weight_id == -1).all()
    assert not picture.deep.counts.any()
    assert len(picture.deep.alphas) == 0
