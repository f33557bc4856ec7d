"""Colour spaces."""

import shutil
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
import torch
from exr_files import (
    flat_picture,
    header_of,
    parts_of,
    rgba_of,
    write,
)

from dsar.color import linear_from_srgb
from dsar.errors import ExportError
from dsar_exporters import ColorTarget, ExrSequence, ocio_config

# Of a user: names of their own, one space that no registry knows.
OCIO = """ocio_profile_version: 2
environment: {}
roles:
  default: Studio Linear
  scene_linear: Studio Linear
file_rules:
  - !<Rule> {name: Default, colorspace: default}
displays:
  screen:
    - !<View> {name: Raw, colorspace: Dim}
colorspaces:
  - !<ColorSpace>
    name: Studio Linear
    aliases: [lin_rec709_scene]
  - !<ColorSpace>
    name: Studio sRGB
    aliases: [srgb_rec709_scene]
    to_scene_reference: !<ExponentWithLinearTransform> {gamma: 2.4, offset: 0.055}
  - !<ColorSpace>
    name: Dim
    from_scene_reference: !<MatrixTransform> {matrix: [0.5, 0, 0, 0, 0, 0.5, 0, 0, 0, 0, 0.5, 0, 0, 0, 0, 1]}
"""


@pytest.fixture
def config(tmp_path) -> Path:
    path = tmp_path / "studio.ocio"
    path.write_text(OCIO)
    return path


ORANGE = torch.tensor([0.5, 0.2, 0.1])


@pytest.mark.parametrize(
    ("colorspace", "interop", "expected"),
    [
        ("lin_rec709_scene", "lin_rec709_scene", (0.214041, 0.033105, 0.010023)),
        # By the matrices that ACES and the ITU publish.
        ("ACEScg", "lin_ap1_scene", (0.142940, 0.045494, 0.016758)),
        ("scene_linear", "lin_ap1_scene", (0.142940, 0.045494, 0.016758)),
        ("ACES2065-1", "lin_ap0_scene", (0.108554, 0.047114, 0.016176)),
        ("lin_rec2020_scene", "lin_rec2020_scene", (0.145622, 0.045344, 0.015399)),
        ("srgb_rec709_scene", "srgb_rec709_scene", (0.5, 0.2, 0.1)),
    ],
)
def test_files_say_which_colours_they_hold(small, tmp_path, colorspace, interop, expected):
    picture = flat_picture(ORANGE, torch.tensor(0.5), small)
    (path,) = write(tmp_path, picture, layers=("rgba", "Z"), target=ColorTarget(colorspace))
    np.testing.assert_allclose(rgba_of(path)[3, 4], [0.5 * value for value in expected] + [0.5], rtol=1e-3)
    (spec,) = parts_of(path)
    assert spec["colorInteropID"] == spec["oiio:ColorSpace"] == interop
    header = header_of(path)
    assert OpenEXR.checkColorMetadata(header) == 0
    known = OpenEXR.colorInteropIDToChromaticities(interop)
    if known:
        np.testing.assert_allclose(header["chromaticities"], known, rtol=1e-6)
    else:
        assert "chromaticities" not in header


def test_every_part_says_which_colours_its_file_holds(picture, side, tmp_path):
    target = ColorTarget("ACEScg")
    paths = write(tmp_path, picture, side, views="multipart", compression="dwaa", target=target)
    for path in paths:
        for part in range(len(parts_of(path))):
            header = header_of(path, part)
            assert header["colorInteropID"] == "lin_ap1_scene"
            assert OpenEXR.checkColorMetadata(header) == 0


@pytest.mark.parametrize("layers", [("Z",), ("alpha", "id"), ("motion", "crypto")])
def test_files_without_colours_say_so(picture, tmp_path, layers):
    path, _ = write(tmp_path, picture, layers=layers, target=ColorTarget("ACEScg"))
    (spec,) = parts_of(path)
    assert spec["colorInteropID"] == "data"
    assert "chromaticities" not in header_of(path)
    assert OpenEXR.checkColorMetadata(header_of(path)) == 0


def test_a_configuration_that_changes_is_another_job(config, tmp_path):
    target = ColorTarget("Dim", str(config))
    before = ExrSequence(tmp_path, target=target).key
    assert ExrSequence(tmp_path, target=ColorTarget("Dim", str(config))).key == before
    config.write_text(OCIO.replace("0.5, 0, 0, 0", "0.4, 0, 0, 0"))
    assert ExrSequence(tmp_path, target=ColorTarget("Dim", str(config))).key != before
    with pytest.raises(ExportError, match=r"studio\.ocio: it, .* are others on"):
        target.from_display(np.array([[0.5, 0.2, 0.1]], np.float32))


WITH_TABLE = f"""{OCIO.replace("environment: {}", "environment: {LOOK: warm}")}
  - !<ColorSpace>
    name: Graded
    from_scene_reference: !<FileTransform> {{src: "$LOOK.spi1d", interpolation: linear}}
search_path: luts
"""
TABLE = "Version 1\nFrom 0.0 1.0\nLength 2\nComponents 1\n{{\n0.0\n{}\n}}\n"


def test_tables_and_variables_that_a_configuration_refers_to_are_part_of_the_job(tmp_path, monkeypatch):
    (tmp_path / "luts").mkdir()
    for name, top in (("warm", 0.9), ("cold", 0.8)):
        (tmp_path / "luts" / f"{name}.spi1d").write_text(TABLE.format(top))
    path = tmp_path / "show.ocio"
    path.write_text(WITH_TABLE)
    monkeypatch.delenv("LOOK", raising=False)
    default = ColorTarget("Graded", str(path)).key
    monkeypatch.setenv("LOOK", "cold")
    cold = ColorTarget("Graded", str(path)).key
    monkeypatch.setenv("LOOK", "warm")
    assert ColorTarget("Graded", str(path)).key == default != cold
    (tmp_path / "luts" / "warm.spi1d").write_text(TABLE.format(0.7))
    assert ColorTarget("Graded", str(path)).key != default
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(tmp_path / "luts", elsewhere / "luts")
    shutil.copy(path, elsewhere)
    assert ColorTarget("Graded", str(elsewhere / "show.ocio")).key == ColorTarget("Graded", str(path)).key


def test_soft_edges_keep_their_colour_in_every_space(small, tmp_path):
    """Colours are freed of their alpha before they become linear: thin and solid ones are the same."""
    for colorspace in ("lin_rec709_scene", "ACEScg"):
        target = ColorTarget(colorspace)
        straight = [
            rgba_of(
                write(
                    tmp_path / colorspace / str(alpha),
                    flat_picture(ORANGE, torch.tensor(alpha), small),
                    layers=("rgba",),
                    target=target,
                )[0]
            )[0, 0]
            for alpha in (1.0, 0.25, 0.01)
        ]
        for found in straight:
            np.testing.assert_allclose(found[:3] / found[3], straight[0][:3], rtol=2e-3)


@pytest.mark.parametrize(
    ("name", "interop", "factor"),
    [
        ("lin_rec709_scene", "lin_rec709_scene", 1.0),
        ("Studio Linear", "lin_rec709_scene", 1.0),
        ("scene_linear", "lin_rec709_scene", 1.0),
        ("Dim", "unknown", 0.5),
    ],
)
def test_a_configuration_of_the_users_is_used(picture, small, config, tmp_path, name, interop, factor):
    target = ColorTarget(name, str(config))
    plain = flat_picture(ORANGE, torch.tensor(0.5), small)
    path = write(tmp_path / "plain", plain, layers=("rgba",), target=target)[0]
    expected = linear_from_srgb(ORANGE.numpy()) * 0.5 * factor
    np.testing.assert_allclose(rgba_of(path)[0, 0, :3], expected, rtol=1e-3)
    header = header_of(path)
    assert header["colorInteropID"] == interop
    assert ("chromaticities" in header) == (interop != "unknown")
    assert OpenEXR.checkColorMetadata(header) == 0
    flat, deep = write(tmp_path / "figure", picture, layers=("rgba",), target=target)
    flattened = oiio.ImageBufAlgo.flatten(oiio.ImageBuf(str(deep))).get_pixels(oiio.FLOAT)
    np.testing.assert_allclose(flattened[..., :4], rgba_of(flat), atol=1e-3)


def test_a_configuration_is_told_apart_from_others(config, tmp_path):
    ours, theirs = ExrSequence(tmp_path), ExrSequence(tmp_path, target=ColorTarget(config=str(config)))
    assert ours.key != theirs.key


def test_colour_spaces_and_configurations_that_do_not_exist_are_refused(config, tmp_path):
    with pytest.raises(ExportError, match=r"known to OCIO \(.*studio.ocio\).*found 'ACEScg'"):
        ColorTarget("ACEScg", str(config))
    with pytest.raises(ExportError, match="found 'rec2021'"):
        ColorTarget("rec2021")
    with pytest.raises(ExportError, match=r"none\.ocio: expected an OCIO configuration, found no such file"):
        ColorTarget("Dim", str(tmp_path / "none.ocio"))
    with pytest.raises(ExportError, match=r"none\.ocio: expected an OCIO configuration, found no such file"):
        # Not even for the default space: the user meant something by it.
        ColorTarget(config=str(tmp_path / "none.ocio"))
    config.write_text("colorspaces: [")
    with pytest.raises(ExportError, match="found one that cannot be read"):
        ColorTarget("Dim", str(config))


def test_a_configuration_without_srgb_is_refused(tmp_path):
    path = tmp_path / "blind.ocio"
    path.write_text(OCIO.replace("srgb_rec709_scene", "camera_log"))
    with pytest.raises(ExportError, match="expected a colour space for sRGB textures"):
        ColorTarget("Dim", str(path))


def test_the_configuration_is_the_named_one_else_the_environments(monkeypatch):
    monkeypatch.delenv("OCIO", raising=False)
    assert ocio_config(None) == ColorTarget().config
    monkeypatch.setenv("OCIO", "/studio/config.ocio")
    assert ocio_config(None) == "/studio/config.ocio"
    assert ocio_config(Path("other.ocio")) == "other.ocio"
    monkeypatch.setenv("OCIO", "")
    assert ocio_config(None) == ColorTarget().config
