"""Deep images."""

from itertools import pairwise

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
from exr_files import (
    DEEP,
    channels_of,
    parts_of,
    rgba_of,
    types_of,
    write,
)

from dsar_exporters import ColorTarget


@pytest.mark.parametrize(
    ("most", "settings", "colorspace"),
    [
        (1, {}, "lin_rec709_scene"),
        (4, {"crop": True}, "lin_rec709_scene"),
        (32, {}, "lin_rec709_scene"),
        (32, {"crop": True}, "ACEScg"),
        (4, {}, "ACEScg"),
        (32, {"views": "multipart", "compression": "dwaa"}, "lin_rec709_scene"),
    ],
)
@pytest.mark.parametrize("overscan", [0, 5])
def test_deep_files_flatten_to_the_flat_one(take, figure, tmp_path, most, settings, colorspace, overscan):
    picture = take(aovs=("rgba",), deep=True, deep_max_samples=most, overscan=overscan)
    target = ColorTarget(colorspace)
    flat, deep = write(tmp_path / "a", picture, layers=("rgba",), target=target, **settings)
    if settings.get("compression"):
        # The flat one, without the loss.
        settings = settings | {"compression": "zips"}
        flat = write(tmp_path / "b", picture, layers=("rgba",), target=target, **settings)[0]
    image = oiio.ImageBuf(str(deep))
    spec, (plain,) = image.spec(), parts_of(flat)
    assert spec.deep
    assert types_of(spec) == DEEP
    assert spec["compression"] == "zips"
    windows = ("x", "y", "width", "height", "full_x", "full_y", "full_width", "full_height")
    assert [getattr(spec, name) for name in windows] == [getattr(plain, name) for name in windows]
    flattened = oiio.ImageBufAlgo.flatten(image)
    assert not flattened.has_error, flattened.geterror()
    expected = rgba_of(flat)
    np.testing.assert_allclose(flattened.get_pixels(oiio.FLOAT)[..., :4], expected, atol=1e-3)
    data, places = image.deepdata(), [spec.channelindex(name) for name in ("Z", "particleid", "A")]
    counts = np.array([data.samples(pixel) for pixel in range(spec.width * spec.height)])
    np.testing.assert_array_equal(counts > 0, (expected[..., 3] > 0).ravel())
    assert counts.max() == min(most, counts.max())
    if most <= 4:
        assert counts.max() == most
    for pixel in np.flatnonzero(counts)[::3]:
        samples = range(counts[pixel])
        depths = [data.deep_value(int(pixel), places[0], sample) for sample in samples]
        assert all(later >= earlier > 0 for earlier, later in pairwise(depths))
        ids = [data.deep_value_uint(int(pixel), places[1], sample) for sample in samples]
        assert max(ids) < figure.num_gaussians
        alphas = [data.deep_value(int(pixel), places[2], sample) for sample in samples]
        assert 0 < min(alphas) <= max(alphas) < 1


def test_unmerged_samples_start_with_the_flat_files_front_and_hold_its_heaviest(take, tmp_path):
    flat, deep = write(tmp_path, take(deep=True, deep_max_samples=10**6))
    image = oiio.ImageBuf(str(deep))
    spec, data, found = image.spec(), image.deepdata(), channels_of(flat)
    front, heaviest = found["front.Z"].ravel(), found["id"].ravel()
    z, particle, a = (spec.channelindex(name) for name in ("Z", "particleid", "A"))
    for pixel in map(int, np.flatnonzero(found["A"].ravel())[::5]):
        samples = range(data.samples(pixel))
        assert data.deep_value(pixel, z, 0) == pytest.approx(front[pixel], abs=1e-5)
        alphas = np.array([data.deep_value(pixel, a, sample) for sample in samples])
        shares = alphas * np.cumprod(np.append(1.0, 1 - alphas[:-1]))
        ids = [data.deep_value_uint(pixel, particle, sample) for sample in samples]
        # Of shares that are equal but for rounding either may count as the larger.
        assert shares[ids.index(heaviest[pixel])] > shares.max() - 1e-5


def test_openexr_reads_deep_files(picture, tmp_path):
    _, deep = write(tmp_path, picture)
    with OpenEXR.File(str(deep), separate_channels=True) as file:
        (part,) = file.parts
        assert part.header["type"] == OpenEXR.deepscanline
        # Written from Python it would be an integer and not the enumeration that it is.
        assert "deepImageState" not in part.header
        pixels = part.channels["A"].pixels.ravel()
        counts = [0 if samples is None else len(samples) for samples in pixels]
    np.testing.assert_array_equal(counts, picture.deep.counts.flatten())


def test_without_deep_samples_there_is_no_deep_file(take, tmp_path):
    assert len(write(tmp_path, take())) == 1
    assert len(list(tmp_path.rglob("*.exr"))) == 1
