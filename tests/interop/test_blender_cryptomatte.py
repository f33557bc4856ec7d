"""Blender's own Cryptomatte node takes parts of the body out of our EXR."""

import subprocess
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from dsar.geometry.camera_paths import CameraPath
from dsar_exporters import ExrSequence
from dsar_render import RenderSettings, iterate_triplets, label_sequence, render_picture

PROBE = Path(__file__).with_name("blender_cryptomatte_probe.py")


@pytest.mark.parametrize("part", ["left_arm", "head"])
def test_blender_takes_the_matte_of_a_part_out_of_our_file(blender, figure, front, tmp_path, part):
    triplet = next(iterate_triplets(figure, [1002]))
    layers = ("rgba", "Z", "N", "crypto")
    labels = label_sequence(figure)
    settings = RenderSettings(aovs=layers)
    picture = render_picture(triplet, CameraPath((front,)), settings, labels=labels, fps=figure.fps)
    (path,) = ExrSequence(tmp_path, layers=layers).write([picture], ["job"])
    found = tmp_path / "matte.exr"
    arguments = [blender, PROBE, path, found, part, front.width, front.height]
    subprocess.run([*map(str, arguments)], check=True, capture_output=True, timeout=120)
    matte = oiio.ImageBuf(str(found)).get_pixels(oiio.FLOAT)[..., 0]
    expected = picture.aovs.coverage[part].numpy()
    assert expected.sum() > 50
    assert np.abs(matte - expected).max() < 1e-5
