"""An open shutter, overscan, and settings that go together."""

import dataclasses
import math
import re

import numpy as np
import pytest
import torch
from scenes import layers, weighted_sum
from torch import Tensor

from dsar.color import linear_from_srgb, srgb_from_linear
from dsar.errors import ConfigError
from dsar.geometry.camera_paths import CameraPath
from dsar.raster import rasterize
from dsar.types import Gaussians
from dsar_render.aovs import AOVS
from dsar_render.picture import render_picture
from dsar_render.settings import RenderSettings
from dsar_render.triplets import FrameTriplet


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
    alike = FrameTriplet(middle.frame, middle.current, middle.current, middle.current)
    settings = RenderSettings(AOVS, motion_samples=5, shutter=(-0.5, 0.5))
    found, sharp = layers(render_picture(alike, still, settings, labels=labels)), layers(everything)
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
    found = render_picture(middle, path, settings).output
    moments = [rasterize(middle.interpolate(time), path.at(middle.frame + time)) for time in settings.times]
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
    picture = render_picture(FrameTriplet(5, white, white, black), CameraPath((front,)), settings)
    color, alpha = picture.output.color, picture.output.alpha
    place = np.unravel_index(int(alpha.argmax()), alpha.shape)
    # Half a frame before it is white; half a frame later, halfway to black, sRGB .5 or a light of .214.
    expected = srgb_from_linear((1 + linear_from_srgb(np.full(1, 0.5))) / 2)
    assert float(color[place][0] / alpha[place]) == pytest.approx(float(expected[0]), abs=1e-4)


def test_what_is_no_light_stays_sharp_under_an_open_shutter(middle, still, labels, everything):
    settings = RenderSettings(AOVS, motion_samples=2, shutter=(-0.25, 0.25))
    found, sharp = layers(render_picture(middle, still, settings, labels=labels)), layers(everything)
    blurred = {"color", "alpha", *everything.aovs.coverage}
    for name in set(sharp) - blurred:
        assert torch.equal(found[name], sharp[name]), name
    assert not torch.equal(found["alpha"], sharp["alpha"])
    assert not torch.equal(found["left_hand"], sharp["left_hand"])


@pytest.mark.parametrize("settings", [{}, {"motion_samples": 3, "shutter": (-0.25, 0.25)}, {"overscan": 9}])
def test_coverage_of_the_parts_sums_to_alpha(middle, still, labels, settings):
    picture = render_picture(middle, still, RenderSettings(("rgba", "crypto"), **settings), labels=labels)
    shares = torch.stack(list(picture.aovs.coverage.values()))
    assert list(picture.aovs.coverage) == list(labels.names)
    assert (shares >= 0).all()
    torch.testing.assert_close(shares.sum(0), picture.output.alpha, atol=2e-6, rtol=0)
    for name in ("head", "left_foot", "right_hand"):
        assert picture.aovs.coverage[name].max() > 0.5


def test_coverage_is_the_share_of_the_parts_own_gaussians(everything, blended, labels):
    ones = torch.eye(len(labels.names))[torch.from_numpy(labels.indices).long()]
    expected = weighted_sum(blended, ones)
    found = torch.stack(list(everything.aovs.coverage.values()), -1)
    assert (found - expected).abs().max() < 1e-6
    # A part that is not in a pixel has no share at all, not even a rounding's: it would fill a matte's rank.
    assert not found[expected == 0].any()


@pytest.mark.parametrize("overscan", [1, 16, 100])
def test_overscan_adds_around_the_picture_and_leaves_it_as_it_is(middle, still, labels, everything, overscan):
    wide = render_picture(middle, still, RenderSettings(AOVS, overscan=overscan), labels=labels)
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
    picture = render_picture(middle, close, RenderSettings(("rgba",), overscan=60))
    whole = render_picture(middle, CameraPath((front,)), RenderSettings(("rgba",)))
    torch.testing.assert_close(picture.output.alpha, whole.output.alpha[:184, :184], atol=1e-4, rtol=0)


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
