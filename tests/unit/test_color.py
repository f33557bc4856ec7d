import numpy as np
import pytest

from dsar.color import linear_from_srgb
from dsar_exporters.color import ColorTarget


def test_srgb_curve_has_its_published_values():
    srgb = np.array([-0.5, 0.0, 0.04045, 0.5, 1.0], np.float32)
    expected = [0.0, 0.0, 0.04045 / 12.92, 0.214041, 1.0]
    np.testing.assert_allclose(linear_from_srgb(srgb), expected, rtol=1e-5)


def test_partial_coverage_keeps_the_colour_and_scales_its_light():
    color = np.full((2, 2, 3), 0.8, np.float32)
    full = ColorTarget().premultiplied(color, np.ones((2, 2), np.float32))
    alpha = np.array([[0.5, 0.25], [1e-3, 0.0]], np.float32)
    part = ColorTarget().premultiplied(color * alpha[..., None], alpha)
    np.testing.assert_allclose(part, full * alpha[..., None], rtol=1e-5)


@pytest.mark.parametrize("alias", ["ACEScg", "lin_ap1_scene", "scene_linear"])
def test_aliases_and_roles_share_one_interop_id(alias):
    assert ColorTarget(alias).interop_id == "lin_ap1_scene"


def test_ocio_agrees_that_our_decoding_is_linear_rec709():
    # Back to encoded sRGB through OCIO must give what went in.
    color = np.random.default_rng(0).random((4, 5, 3), np.float32)
    encoded = ColorTarget("srgb_rec709_scene").premultiplied(color, np.ones((4, 5), np.float32))
    np.testing.assert_allclose(encoded, color, atol=1e-4)
