"""Which channels a layer becomes, and what is in them."""

import dataclasses

import numpy as np
import OpenEXR
import pytest
import torch
from exr_files import (
    CHANNELS,
    bits,
    channels_of,
    flat_picture,
    parts_of,
    rgba_of,
    types_of,
    write,
)

from dsar.color import linear_from_srgb
from dsar.errors import ExportError
from dsar_exporters import ExrSequence
from dsar_render.aovs import AOVS


@pytest.mark.parametrize("layer", AOVS)
def test_each_layer_has_its_channels_and_types(picture, tmp_path, layer):
    path, _ = write(tmp_path, picture, layers=(layer,))
    (spec,) = parts_of(path)
    assert types_of(spec) == CHANNELS[layer]


@pytest.mark.parametrize("views", ["separate", "multipart"])
def test_all_layers_have_their_channels_and_types_colours_first(picture, tmp_path, views):
    path, _ = write(tmp_path, picture, views=views)
    (spec,) = parts_of(path)
    expected = {name: kind for channels in CHANNELS.values() for name, kind in channels.items()}
    assert types_of(spec) == expected
    assert spec.channelnames[:4] == ("R", "G", "B", "A")


def test_pixels_are_those_of_the_picture(picture, tmp_path):
    found = channels_of(write(tmp_path, picture)[0])
    output, aovs = picture.output, picture.aovs
    alpha = output.alpha.numpy()
    assert bits(found["A"]) == bits(alpha.astype(np.float16))
    assert bits(found["Z"]) == bits(output.depth.numpy())
    assert bits(found["front.Z"]) == bits(output.first_hit_depth.numpy())
    for layer, values in (("N", aovs.normals), ("P", aovs.positions)):
        stored = np.stack([found[f"{layer}.{axis}"] for axis in "XYZ"], -1)
        np.testing.assert_array_equal(stored, values)
    for layer, values in (("forward", aovs.forward), ("backward", aovs.backward)):
        np.testing.assert_array_equal(found[f"{layer}.u"], values[..., 0])
        # Ours point down, compositors' up.
        np.testing.assert_array_equal(found[f"{layer}.v"], -values[..., 1])
    heaviest = output.largest_weight_id.numpy()
    assert found["id"].dtype == np.uint32
    np.testing.assert_array_equal(found["id"], np.where(alpha > 0, heaviest, 0xFFFFFFFF))
    solid = alpha > 0.1
    straight = output.color.numpy()[solid] / alpha[solid, None]
    expected = linear_from_srgb(straight) * alpha[solid, None]
    stored = np.stack([found[name] for name in "RGB"], -1)[solid].astype(np.float32)
    np.testing.assert_allclose(stored, expected, rtol=6e-4, atol=1e-6)


def test_openexr_reads_the_same_as_openimageio(picture, tmp_path):
    path, _ = write(tmp_path, picture)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        stored = {name: channel.pixels.copy() for name, channel in file.parts[0].channels.items()}
    found = channels_of(path)
    assert stored.keys() == found.keys()
    for name, values in stored.items():
        assert values.dtype == found[name].dtype
        assert bits(values) == bits(found[name]), name


def test_colours_brighter_than_half_floats_can_say_stay_finite(small, tmp_path):
    bright = flat_picture(torch.tensor([1e4, 0.5, 0.0]), torch.tensor(1.0), small)
    found = rgba_of(write(tmp_path, bright, layers=("rgba",))[0])
    assert found[0, 0, 0] == 65504
    assert found[0, 0, 1] == pytest.approx(0.21404, rel=1e-3)


@pytest.mark.parametrize(
    ("layer", "told"), [("N", "N"), ("P", "P"), ("motion", "motion"), ("id", "id"), ("crypto", "crypto")]
)
def test_a_layer_that_was_not_rendered_is_refused_and_leaves_no_file(small, tmp_path, layer, told):
    plain = flat_picture(torch.ones(3), torch.tensor(1.0), small)
    with pytest.raises(ExportError, match=f"render it with --aov {told}"):
        write(tmp_path, plain, layers=("rgba", layer))
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_files_have_the_names_that_sequences_have(picture, side, tmp_path):
    separate = write(tmp_path / "a", picture, side, name="anna")
    together = write(tmp_path / "b", picture, side, name="anna", views="multipart")
    deep = ["front/anna_deep.front.1003.exr", "side/anna_deep.side.1003.exr"]
    assert [str(path.relative_to(tmp_path / "a")) for path in separate] == [
        "front/anna.front.1003.exr",
        "side/anna.side.1003.exr",
        *deep,
    ]
    assert [str(path.relative_to(tmp_path / "b")) for path in together] == ["anna.1003.exr", *deep]
    # Nothing else is left, neither drafts nor their folders.
    assert {path for path in tmp_path.rglob("*") if not path.is_dir()} == {*separate, *together}
    assert {path.name for path in tmp_path.rglob("*") if path.is_dir()} == {"a", "b", "front", "side"}


def test_names_that_no_application_takes_are_refused(tmp_path, front):
    with pytest.raises(ExportError, match="found 'a b'"):
        ExrSequence(tmp_path, name="a b")
    with pytest.raises(ExportError, match="found '0cam'"):
        ExrSequence(tmp_path).check([dataclasses.replace(front, name="0cam")])


def test_an_image_of_another_size_than_its_cameras_is_refused(picture, tmp_path):
    for wrong in (
        dataclasses.replace(picture, overscan=1),
        dataclasses.replace(picture, camera=picture.camera.resized(96, 128)),
    ):
        with pytest.raises(
            ExportError, match=r"expected an image of \d+x\d+ from camera front, found 192x256"
        ):
            write(tmp_path, wrong)
