from fractions import Fraction

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
import torch

from dsar.errors import ExportError
from dsar.geometry.cameras import project
from dsar.types import Camera, RenderOutput
from dsar_exporters import exr_path, write_exr


@pytest.fixture
def output() -> RenderOutput:
    """Half-covered middle grey, with one uncovered pixel and one brighter than white."""
    alpha = torch.full((96, 128), 0.5)
    alpha[0, 0] = 0.0
    color = torch.full((96, 128, 3), 0.5) * alpha[..., None]
    color[5, 7] = 2.0 * alpha[5, 7]
    depth = torch.linspace(1, 4, 96 * 128).reshape(96, 128)
    return RenderOutput(color, alpha, depth, torch.tensor(0))


@pytest.fixture
def camera(cameras: list[Camera]) -> Camera:
    return cameras[1]


def _write(output, folder, camera, fps=24.0, **options):
    path = exr_path(folder, name="avatar", camera=camera.name, frame=1001)
    provenance = {"checkpoint": "abc123"}
    return write_exr(output, path, camera=camera, frame=1001, fps=fps, provenance=provenance, **options)


def test_channels_types_windows_and_compression(output, camera, tmp_path):
    spec = oiio.ImageInput.open(str(_write(output, tmp_path, camera))).spec()
    assert spec.channelnames == ("R", "G", "B", "A", "Z")
    assert spec.channelformats == (oiio.HALF,) * 4 + (oiio.FLOAT,)
    assert (spec.width, spec.height, spec.full_width, spec.full_height) == (128, 96, 128, 96)
    assert spec["compression"] == "zips"


def test_pixels_are_linear_and_premultiplied(output, camera, tmp_path):
    pixels = oiio.ImageBuf(str(_write(output, tmp_path, camera))).get_pixels(oiio.FLOAT)
    # The sRGB curve at one half is 0.21404; premultiplied by half coverage; half floats keep 3 digits.
    np.testing.assert_allclose(pixels[50, 50, :4], [0.10702] * 3 + [0.5], rtol=1e-3)
    assert not pixels[0, 0, :4].any()
    np.testing.assert_allclose(pixels[5, 7, 0], 0.5 * ((2 + 0.055) / 1.055) ** 2.4, rtol=1e-3)
    np.testing.assert_array_equal(pixels[..., 4], output.depth)


def test_header_names_frame_view_rate_colour_and_origin(output, camera, tmp_path):
    path = _write(output, tmp_path, camera)
    assert path == tmp_path / "cam01" / "avatar.cam01.1001.exr"
    header = OpenEXR.File(str(path), header_only=True).header()
    assert header["framesPerSecond"] == Fraction(24, 1)
    assert header["imageCounter"] == 1001
    assert header["cameraLabel"] == header["view"] == "cam01"
    assert header["multiView"] == ["cam01"]
    assert header["colorInteropID"] == "lin_rec709_scene"
    assert header["dsar/checkpoint"] == "abc123"
    assert OpenEXR.checkColorMetadata(header) == 0


@pytest.mark.parametrize(
    ("fps", "expected"),
    [(23.976, (24000, 1001)), (29.97, (30000, 1001)), (25.0, (25, 1)), (12.5, (25, 2))],
)
def test_openimageio_reads_the_rate_as_the_fraction_it_stands_for(output, camera, tmp_path, fps, expected):
    spec = oiio.ImageInput.open(str(_write(output, tmp_path, camera, fps))).spec()
    assert spec.getattribute("framesPerSecond") == expected


def test_header_matrices_reproduce_the_camera(output, camera, tmp_path):
    spec = oiio.ImageInput.open(str(_write(output, tmp_path, camera))).spec()
    to_camera, to_ndc = (
        np.array(spec.getattribute(name)).reshape(4, 4) for name in ("worldToCamera", "worldToNDC")
    )
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)).double()
    rows = np.concatenate([points.numpy(), np.ones((50, 1))], 1)
    pixels, depth = project(camera, points)
    ndc = rows @ to_ndc
    np.testing.assert_allclose(ndc[:, :2] / ndc[:, 3:] * [128, 96], pixels, atol=1e-3)
    local = rows @ to_camera
    np.testing.assert_allclose(local[:, 2], depth, rtol=1e-6)
    assert np.linalg.det(to_camera[:3, :3]) == pytest.approx(-1)
    # OpenEXR's camera axes are left-handed with y up: what is high in the image has larger y.
    assert np.corrcoef(local[:, 1] / depth.numpy(), pixels[:, 1])[0, 1] == pytest.approx(-1)


def test_acescg_moves_the_primaries_and_is_tagged(output, camera, tmp_path):
    red = torch.zeros(96, 128, 3)
    red[..., 0] = 0.5
    image = RenderOutput(red, torch.full((96, 128), 0.5), output.depth, torch.tensor(0))
    path = _write(image, tmp_path, camera, colorspace="ACEScg")
    found = oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)[0, 0, :4]
    # Rec.709 red in AP1, as published with ACES, at half coverage.
    np.testing.assert_allclose(found, [0.5 * 0.61310, 0.5 * 0.07019, 0.5 * 0.02062, 0.5], rtol=2e-3)
    header = OpenEXR.File(str(path), header_only=True).header()
    assert header["colorInteropID"] == "lin_ap1_scene"


def test_an_unknown_colour_space_is_refused_and_leaves_no_file(output, camera, tmp_path):
    with pytest.raises(ExportError, match=r"such as lin_rec709_scene or ACEScg, found 'rec2021'"):
        _write(output, tmp_path, camera, colorspace="rec2021")
    assert not list(tmp_path.iterdir())


def test_an_image_of_another_size_is_refused(output, camera, tmp_path):
    with pytest.raises(ExportError, match="expected an image of 64x48 from camera cam01, found 128x96"):
        _write(output, tmp_path, camera.resized(64, 48))


def test_a_write_that_fails_keeps_the_earlier_image(output, camera, tmp_path, monkeypatch):
    path = _write(output, tmp_path, camera)
    before = path.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(OpenEXR.File, "write", fail)
    with pytest.raises(OSError, match="disk full"):
        _write(output, tmp_path, camera)
    assert list(path.parent.iterdir()) == [path]
    assert path.read_bytes() == before
