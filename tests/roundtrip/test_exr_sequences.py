"""EXR sequences as other applications' libraries read them: OpenImageIO, and OpenEXR where it says so."""

import dataclasses
import json
import re
import struct
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import mmh3
import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
import torch
from PIL import Image

from dsar.color import linear_from_srgb
from dsar.errors import ExportError
from dsar.geometry.cameras import look_at, project
from dsar.geometry.paths import CameraPath
from dsar.types import Aovs, Camera, Gaussians, Picture, RenderOutput
from dsar_exporters import ColorTarget, ExrSequence, ocio_config
from dsar_exporters.exr.cryptomatte import float_id, matte_channels
from dsar_render.aovs import AOVS
from dsar_render.images import PngSequence
from dsar_render.instants import Instant, iterate_instants
from dsar_render.labels import Labels, label_parts
from dsar_render.picture import RenderSettings, take_picture

PROVENANCE = {"checkpoint": "abc123", "motion": "turn", "dsar": "0.1"}
LOSSLESS = ("none", "rle", "zips", "zip", "piz")
LOSSY = ("pxr24", "b44", "b44a", "dwaa", "dwab")
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


# What is written


@pytest.fixture(scope="module")
def middle(figure) -> Instant:
    return next(iter(iterate_instants(figure, {1003})))


@pytest.fixture(scope="module")
def labels(figure) -> Labels:
    """The body's parts, and a garment over its right half."""
    binding = figure.binding
    uv = binding.uv.clone()
    uv[binding.points[:, 0] < 0, 1] = -0.5
    names, of = label_parts(dataclasses.replace(binding, uv=uv))
    return Labels(names, of.numpy().astype(np.uint8))


@pytest.fixture(scope="module")
def take(middle, labels, front):
    """Return a function that takes pictures of the figure's middle frame."""

    def taken(camera: Camera = front, instant: Instant = middle, fps: float = 24.0, **settings) -> Picture:
        found = RenderSettings(**({"aovs": AOVS} | settings))
        path = CameraPath((camera,))
        return take_picture(instant, path, found, labels=labels, fps=fps, provenance=PROVENANCE)

    return taken


@pytest.fixture(scope="module")
def picture(take) -> Picture:
    return take(deep=True)


@pytest.fixture(scope="module")
def wide(take) -> Picture:
    return take(deep=True, overscan=11)


@pytest.fixture(scope="module")
def side(front, take) -> Picture:
    """The same from another camera of the same size."""
    view = look_at(np.array([2.8, 0.4, 1.2]), np.array([0.0, -0.2, 0.0]))
    return take(dataclasses.replace(front, T_camera_world=view, name="side"), deep=True)


@pytest.fixture(scope="module")
def nothing(front, take) -> Picture:
    view = look_at(np.array([0.0, 0.0, 5.0]), np.array([0.0, 0.0, 9.0]))
    return take(dataclasses.replace(front, T_camera_world=view), deep=True)


def flat_picture(color: torch.Tensor, alpha: torch.Tensor, camera: Camera, **fields) -> Picture:
    """Return a picture of straight colours that are the same everywhere in it."""
    size = (camera.height, camera.width)
    output = RenderOutput(
        (color * alpha).expand(*size, 3), alpha.expand(size), torch.ones(size), torch.tensor(0)
    )
    return Picture(1001, camera, output, **fields)


@pytest.fixture
def small(front) -> Camera:
    return front.cropped(80, 80, 16, 12)


def write(folder: Path, *pictures: Picture, layers=AOVS, **settings) -> list[Path]:
    jobs = [f"job of {picture.camera.name}" for picture in pictures]
    return ExrSequence(folder, layers=layers, **settings).write(pictures, jobs)


# How it is read


def parts_of(path: Path) -> list[oiio.ImageSpec]:
    file = oiio.ImageInput.open(str(path))
    assert file is not None, oiio.geterror()
    specs = []
    while file.seek_subimage(len(specs), 0):
        specs.append(file.spec().copy())
    file.close()
    return specs


def types_of(spec: oiio.ImageSpec) -> dict[str, str]:
    formats = spec.channelformats or (spec.format,) * spec.nchannels
    return {name: str(kind) for name, kind in zip(spec.channelnames, formats, strict=True)}


def channels_of(path: Path) -> dict[str, np.ndarray]:
    """Return all channels of all parts, each in its own type; of several parts as `part/channel`."""
    file, specs, found = oiio.ImageInput.open(str(path)), parts_of(path), {}
    for index, spec in enumerate(specs):
        prefix = f"{spec['oiio:subimagename']}/" if len(specs) > 1 else ""
        for place, (name, kind) in enumerate(types_of(spec).items()):
            pixels = file.read_image(index, 0, place, place + 1, oiio.TypeDesc(kind))
            assert pixels is not None, file.geterror()
            found[prefix + name] = pixels[..., 0]
    file.close()
    return found


def unprefixed(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name.rpartition("/")[2]: values for name, values in channels.items()}


def rgba_of(path: Path) -> np.ndarray:
    found = unprefixed(channels_of(path))
    return np.stack([found[name] for name in "RGBA"], -1).astype(np.float32)


def header_of(path: Path, part: int = 0) -> dict:
    with OpenEXR.File(str(path), header_only=True) as file:
        return dict(file.parts[part].header)


def bits(values: np.ndarray) -> bytes:
    return np.ascontiguousarray(values).tobytes()


# Channels

HALF = dict.fromkeys("RGBA", "half")
MATTES = {f"CryptoMaterial{rank:02d}.{name}": "float" for rank in range(3) for name in "RGBA"}
CHANNELS = {
    "rgba": HALF,
    "alpha": {"A": "half"},
    "Z": {"Z": "float", "front.Z": "float"},
    "N": {"N.X": "float", "N.Y": "float", "N.Z": "float"},
    "P": {"P.X": "float", "P.Y": "float", "P.Z": "float"},
    "motion": {"forward.u": "float", "forward.v": "float", "backward.u": "float", "backward.v": "float"},
    "id": {"id": "uint"},
    "crypto": MATTES,
}


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
    assert bits(found["front.Z"]) == bits(output.front_depth.numpy())
    for layer, values in (("N", aovs.normals), ("P", aovs.positions)):
        stored = np.stack([found[f"{layer}.{axis}"] for axis in "XYZ"], -1)
        np.testing.assert_array_equal(stored, values)
    for layer, values in (("forward", aovs.forward), ("backward", aovs.backward)):
        np.testing.assert_array_equal(found[f"{layer}.u"], values[..., 0])
        # Ours point down, compositors' up.
        np.testing.assert_array_equal(found[f"{layer}.v"], -values[..., 1])
    heaviest = output.heaviest.numpy()
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


# Where things are


def dot(place: torch.Tensor) -> Gaussians:
    """One small opaque Gaussian."""
    return Gaussians(
        place[None],
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.full((1, 3), 0.006),
        torch.ones(1),
        torch.ones(1, 1, 3),
    )


def centroid(path: Path) -> tuple[np.ndarray, float]:
    """Return the middle of what is seen, in pixels of the display window, and its largest alpha."""
    (spec,) = parts_of(path)
    alpha = channels_of(path)["A"].astype(np.float64)
    y, x = np.mgrid[: spec.height, : spec.width]
    # Pixels' coordinates are those of the display window.
    places = np.stack([x + spec.x, y + spec.y], -1) + 0.5 - [spec.full_x, spec.full_y]
    return (places * alpha[..., None]).sum((0, 1)) / alpha.sum(), float(alpha.max())


POINTS = {"middle": (0.1, 0.9, 0.0), "corner": (-0.55, 1.35, 0.2), "outside": (1.15, 0.9, 0.3)}


@pytest.mark.parametrize("cropped", [False, True], ids=["whole", "cropped"])
@pytest.mark.parametrize("overscan", [0, 45])
@pytest.mark.parametrize("point", POINTS)
def test_the_headers_matrices_find_a_known_point(cameras, tmp_path, take, point, overscan, cropped):
    place = torch.tensor(POINTS[point])
    thing = dot(place)
    # Coarse pixels that are not square, a principal point off the middle; the last one is rolled to its side.
    rolled = cameras[0].T_camera_world.clone()
    rolled[:2] = torch.stack([rolled[1], -rolled[0]])
    views = [*cameras, dataclasses.replace(cameras[0], T_camera_world=rolled, name="rolled")]
    seen = 0
    for view in views:
        picture = take(view, Instant(1003, thing), aovs=("rgba", "Z", "P"), overscan=overscan)
        pixel = project(view, place)[0]
        room = torch.tensor([view.width, view.height]) + overscan - 4
        if not ((pixel > 4 - overscan) & (pixel < room)).all():
            continue
        seen += 1
        (path,) = write(tmp_path / view.name, picture, layers=("rgba", "Z", "P"), crop=cropped)
        (spec,) = parts_of(path)
        to_ndc, to_camera = (
            np.array(spec.getattribute(name)).reshape(4, 4) for name in ("worldToNDC", "worldToCamera")
        )
        row = np.append(place.numpy(), 1.0)
        ndc = row @ to_ndc
        expected = ndc[:2] / ndc[3] * [spec.full_width, spec.full_height]
        found, peak = centroid(path)
        assert peak > 0.5
        np.testing.assert_allclose(found, expected, atol=0.05)
        # The pixel that holds it, counted from the data window's corner, says where it is in the world.
        column, line = np.floor(expected).astype(int) - [spec.x, spec.y]
        pixels = channels_of(path)
        world = np.array([pixels[f"P.{axis}"][line, column] for axis in "XYZ"])
        np.testing.assert_allclose(world, place, atol=0.02)
        right, up, forward, _ = row @ to_camera
        assert pixels["Z"][line, column] == pytest.approx(forward, abs=1e-4)
        # OpenEXR's camera axes are left-handed: x right, y up, z forward.
        K = view.K.numpy()
        local = np.array([right, -up]) / forward * K[[0, 1], [0, 1]] + K[:2, 2]
        np.testing.assert_allclose(local, expected, atol=1e-3)
    assert seen >= (0 if point == "outside" and not overscan else 1)


@pytest.mark.parametrize("cropped", [False, True], ids=["whole", "cropped"])
def test_overscan_widens_the_data_window_and_not_the_display_window(wide, tmp_path, cropped):
    for path in write(tmp_path, wide, crop=cropped):
        (spec,) = parts_of(path)
        assert (spec.full_x, spec.full_y, spec.full_width, spec.full_height) == (0, 0, 192, 256)
        if not cropped:
            assert (spec.x, spec.y, spec.width, spec.height) == (-11, -11, 214, 278)
        header = header_of(path)
        np.testing.assert_array_equal(header["displayWindow"], ([0, 0], [191, 255]))
        np.testing.assert_array_equal(
            header["dataWindow"],
            ([spec.x, spec.y], [spec.x + spec.width - 1, spec.y + spec.height - 1]),
        )


def pasted(path: Path, x: int, y: int, width: int, height: int) -> dict[str, np.ndarray]:
    """Return channels in a window that they may fill only in part; zero, and no id, elsewhere."""
    (spec,) = parts_of(path)
    found = {}
    for name, values in channels_of(path).items():
        whole = np.full((height, width), 0xFFFFFFFF if name == "id" else 0, values.dtype)
        top, left = spec.y - y, spec.x - x
        whole[top : top + spec.height, left : left + spec.width] = values
        found[name] = whole
    return found


@pytest.mark.parametrize("which", ["picture", "wide"])
def test_a_cropped_file_pasted_into_its_window_is_the_whole_one(tmp_path, request, which):
    picture = request.getfixturevalue(which)
    whole, cropped = (write(tmp_path / str(crop), picture, crop=crop)[0] for crop in (False, True))
    (spec,) = parts_of(whole)
    expected, found = (pasted(path, spec.x, spec.y, spec.width, spec.height) for path in (whole, cropped))
    for name, values in expected.items():
        # No -0 becomes 0: only values count.
        np.testing.assert_array_equal(found[name], values, err_msg=name)
    # As tight as can be.
    (tight,) = parts_of(cropped)
    alpha = picture.output.alpha.numpy() > 0
    rows, columns = np.flatnonzero(alpha.any(1)), np.flatnonzero(alpha.any(0))
    assert (tight.y - spec.y, tight.height) == (rows[0], rows[-1] - rows[0] + 1)
    assert (tight.x - spec.x, tight.width) == (columns[0], columns[-1] - columns[0] + 1)


@pytest.mark.parametrize("colorspace", ["lin_rec709_scene", "ACEScg"])
@pytest.mark.parametrize("compression", ["zips", "dwaa"])
@pytest.mark.parametrize("cropped", [False, True], ids=["whole", "cropped"])
def test_an_empty_picture_still_makes_readable_files(nothing, tmp_path, cropped, compression, colorspace):
    settings = {"crop": cropped, "compression": compression, "target": ColorTarget(colorspace)}
    flat, deep = write(tmp_path, nothing, **settings)
    found = unprefixed(channels_of(flat))
    assert (found.pop("id") == 0xFFFFFFFF).all()
    assert not any(values.any() for values in found.values())
    (spec,) = parts_of(deep)
    assert spec.deep
    assert types_of(spec) == DEEP
    assert (spec.width, spec.height) == ((1, 1) if cropped else (192, 256))
    data = oiio.ImageBuf(str(deep)).deepdata()
    assert sum(data.samples(pixel) for pixel in range(spec.width * spec.height)) == 0
    assert ExrSequence(tmp_path).complete(1003, ["front"], ["job of front"], True)


# Views


def attributes(path: Path) -> list[tuple[str | None, object]]:
    """Return each part's `view` and `multiView`, in OpenEXR's words."""
    with OpenEXR.File(str(path), header_only=True) as file:
        return [(part.header.get("view"), part.header.get("multiView")) for part in file.parts]


def test_a_file_of_one_view_says_so_in_both_ways(picture, side, tmp_path):
    for path in write(tmp_path, picture, side):
        camera = path.parent.name
        assert attributes(path) == [(camera, [camera])]


@pytest.mark.parametrize("compression", ["zips", "dwaa"])
def test_parts_have_a_view_each_and_no_list_of_views(picture, side, tmp_path, compression):
    path, *_ = write(tmp_path, picture, side, views="multipart", compression=compression)
    each = 1 if compression == "zips" else 2
    assert attributes(path) == [("front", None)] * each + [("side", None)] * each
    specs = parts_of(path)
    names = [spec["oiio:subimagename"] for spec in specs]
    assert len(set(names)) == len(names) == 2 * each
    # What OpenEXR wants all parts of a file to agree on.
    for key in ("displayWindow", "pixelAspectRatio", "timeCode", "chromaticities"):
        assert len({str(header_of(path, part)[key]) for part in range(len(specs))}) == 1
    found = channels_of(path)
    for view in (picture, side):
        (prefix,) = (name for name in names if name.endswith(view.camera.name) and "data" not in name)
        alpha = found[f"{prefix}/A"].astype(np.float32)
        assert np.abs(alpha - view.output.alpha.numpy()).max() < (1e-3 if each == 1 else 0.02)
        data = prefix.replace("rgba.", "data.")
        assert bits(found[f"{data}/Z"]) == bits(view.output.depth.numpy())
    # No channel names a view: that is what the parts are for.
    assert not any("front." in name and "front.Z" not in name for name in specs[0].channelnames)


def test_a_lossy_file_of_one_view_has_two_parts_of_that_view(picture, tmp_path):
    path, _ = write(tmp_path, picture, compression="dwaa")
    assert attributes(path) == [("front", None), ("front", None)]


def test_views_of_different_sizes_do_not_go_into_one_file(front, tmp_path):
    views = [front, dataclasses.replace(front.resized(96, 128), name="small")]
    with pytest.raises(ExportError, match=r"cameras of one size, found \[\(96, 128\), \(192, 256\)\]"):
        ExrSequence(tmp_path, views="multipart").check(views)
    ExrSequence(tmp_path, views="separate").check(views)
    ExrSequence(tmp_path, views="multipart").check(views[:1])


# Cryptomatte


def murmur(name: str) -> int:
    """MurmurHash3_x86_32 with seed 0, from its published description."""

    def rotated(value: int, by: int) -> int:
        return (value << by | value >> 32 - by) & 0xFFFFFFFF

    def scrambled(word: int) -> int:
        return rotated(word * 0xCC9E2D51 & 0xFFFFFFFF, 15) * 0x1B873593 & 0xFFFFFFFF

    data, state = name.encode(), 0
    whole = len(data) // 4 * 4
    for (word,) in struct.iter_unpack("<I", data[:whole]):
        state = (rotated(state ^ scrambled(word), 13) * 5 + 0xE6546B64) & 0xFFFFFFFF
    state ^= scrambled(int.from_bytes(data[whole:], "little")) ^ len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        state = (state ^ state >> shift) * factor & 0xFFFFFFFF
    return state ^ state >> 16


def conforming(value: int) -> int:
    """The specification's correction: never a zero, denormal, infinite or undefined float."""
    return value ^ 1 << 23 if value >> 23 & 0xFF in (0, 0xFF) else value


@dataclasses.dataclass
class Mattes:
    """A Cryptomatte layer as a compositor's plug-in sees it."""

    manifest: dict[str, str]
    ids: np.ndarray
    """[h, w, ranks] as unsigned integers."""
    coverage: np.ndarray
    """[h, w, ranks]"""

    def matte(self, name: str) -> np.ndarray:
        return (self.coverage * (self.ids == int(self.manifest[name], 16))).sum(-1)


def decoded(path: Path, part: str = "") -> Mattes:
    """Decode a file's one layer as the specification 1.2 asks."""
    stored = {}
    for spec in parts_of(path):
        if part in str(spec.getattribute("oiio:subimagename")):
            stored |= {
                each.name: each.value for each in spec.extra_attribs if each.name.startswith("cryptomatte/")
            }
    keys = {name.split("/")[1] for name in stored}
    assert len(keys) == 1
    key = keys.pop()
    layer = stored[f"cryptomatte/{key}/name"]
    assert key == f"{murmur(layer):08x}"[:7]
    assert stored[f"cryptomatte/{key}/hash"] == "MurmurHash3_32"
    assert stored[f"cryptomatte/{key}/conversion"] == "uint32_to_float32"
    manifest = json.loads(stored[f"cryptomatte/{key}/manifest"])
    channels = unprefixed(
        {name: v for name, v in channels_of(path).items() if part in name.rpartition("/")[0]}
    )
    names = sorted(name for name in channels if re.fullmatch(rf"{layer}\d\d\.[RGBA]", name))
    numbers = sorted({name[len(layer) : len(layer) + 2] for name in names})
    assert numbers == [f"{index:02d}" for index in range(len(numbers))]
    pairs = [(f"{layer}{number}.{a}", f"{layer}{number}.{b}") for number in numbers for a, b in ("RG", "BA")]
    assert all(channels[name].dtype == np.float32 for name in names)
    ids = np.stack([np.ascontiguousarray(channels[name]).view(np.uint32) for name, _ in pairs], -1)
    return Mattes(manifest, ids, np.stack([channels[name] for _, name in pairs], -1))


@pytest.mark.parametrize(
    ("name", "published"),
    [
        ("", 0),
        ("test", 0xBA6BD213),
        ("hello", 0x248BFA47),
        ("Hello, world!", 0xC0363E43),
        ("The quick brown fox jumps over the lazy dog", 0x2E4FF723),
        # Of Psyop's own sample images.
        ("bunny", 0x13851A76),
        ("default", 0x42C9679F),
    ],
)
def test_hashes_are_the_published_ones(name, published):
    assert murmur(name) == mmh3.hash(name, 0, signed=False) == published
    if name:
        assert float_id(name).tobytes() == struct.pack("<I", published)
        assert float(float_id(name)) == struct.unpack("<f", struct.pack("<I", published))[0]


@pytest.mark.parametrize("exponent", [0, 255])
def test_ids_that_would_be_no_numbers_are_corrected_as_specified(exponent):
    names = [f"part{index}" for index in range(4000)]
    found = [name for name in names if murmur(name) >> 23 & 255 == exponent]
    assert len(found) > 5
    for name in found:
        number = float_id(name)
        assert np.isfinite(number)
        assert abs(number) >= np.finfo(np.float32).tiny
        assert number.view(np.uint32) == murmur(name) ^ 1 << 23


def test_mattes_are_the_pictures_coverage_and_sum_to_alpha(picture, labels, tmp_path):
    found = decoded(write(tmp_path, picture)[0])
    assert list(found.manifest) == list(labels.names)
    assert found.manifest == {name: f"{conforming(murmur(name)):08x}" for name in labels.names}
    assert {"garment", "head", "left_hand"} <= set(found.manifest)
    for name, coverage in picture.aovs.coverage.items():
        assert np.abs(found.matte(name) - coverage.numpy()).max() < 1e-6, name
        if name not in ("right_arm", "right_hand", "right_leg", "right_foot"):  # which the garment hides
            assert found.matte(name).max() > 0.5, name
    assert found.matte("garment").max() > 0.9
    total = sum(found.matte(name) for name in found.manifest)
    np.testing.assert_allclose(total, picture.output.alpha, atol=1e-6)
    # And what the file's own alpha says, in half floats.
    np.testing.assert_allclose(
        total, rgba_of(tmp_path / "front" / "avatar.front.1003.exr")[..., 3], atol=5e-4
    )


def test_every_rank_is_an_id_of_the_manifest_or_nothing(picture, side, tmp_path):
    for path in write(
        tmp_path, dataclasses.replace(picture, deep=None), dataclasses.replace(side, deep=None)
    ):
        found = decoded(path)
        known = {int(number, 16) for number in found.manifest.values()}
        assert set(np.unique(found.ids)) <= known | {0}
        # An id stands exactly where there is coverage, the largest first.
        np.testing.assert_array_equal(found.ids != 0, found.coverage > 0)
        assert (np.diff(found.coverage, axis=-1) <= 0).all()
        exponents = found.ids[found.ids != 0] >> 23 & 0xFF
        assert exponents.min() > 0
        assert exponents.max() < 255


@pytest.mark.parametrize(
    "settings",
    [{"compression": "dwaa"}, {"compression": "b44"}, {"crop": True}, {"views": "multipart"}],
    ids=str,
)
def test_mattes_survive_every_way_of_writing(picture, tmp_path, settings):
    sharp = decoded(write(tmp_path / "plain", picture)[0])
    found = decoded(write(tmp_path / "other", picture, **settings)[0])
    if settings.get("crop"):
        alpha = picture.output.alpha.numpy() > 0
        rows, columns = np.flatnonzero(alpha.any(1)), np.flatnonzero(alpha.any(0))
        inside = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        sharp = Mattes(sharp.manifest, sharp.ids[inside], sharp.coverage[inside])
    assert found.manifest == sharp.manifest
    assert bits(found.ids) == bits(sharp.ids)
    assert bits(found.coverage) == bits(sharp.coverage)


def test_blurred_mattes_sum_to_the_blurred_alpha(take, figure, tmp_path):
    (instant,) = (each for each in iterate_instants(figure, {1003}) if each.frame == 1003)
    blurred = take(instant=instant, motion_samples=3, shutter=(-0.5, 0.5))
    found = decoded(write(tmp_path, blurred)[0])
    total = sum(found.matte(name) for name in found.manifest)
    np.testing.assert_allclose(total, blurred.output.alpha, atol=2e-6)


def test_where_more_than_six_parts_meet_the_largest_stand_for_all(small, tmp_path):
    generator = torch.Generator().manual_seed(0)
    shares = torch.rand(9, 12, 16, generator=generator)
    alpha = torch.rand(12, 16, generator=generator)
    shares *= alpha / shares.sum(0)
    coverage = {f"part{index}": share for index, share in enumerate(shares)}
    output = RenderOutput(torch.zeros(12, 16, 3), alpha, alpha, torch.tensor(0))
    crowd = Picture(1001, small, output, Aovs(coverage=coverage))
    found = decoded(write(tmp_path, crowd, layers=("rgba", "crypto"))[0])
    np.testing.assert_allclose(found.coverage.sum(-1), alpha, rtol=1e-5)
    order = shares.argsort(0, descending=True)
    names = np.array([conforming(murmur(f"part{index}")) for index in range(9)], np.uint32)
    np.testing.assert_array_equal(found.ids, names[order[:6].permute(1, 2, 0).numpy()])


def test_a_single_part_is_a_layer_too():
    found = matte_channels({"all": torch.tensor([[0.5, 0.0]])})
    assert list(found) == ["CryptoMaterial00", "CryptoMaterial01", "CryptoMaterial02"]
    np.testing.assert_array_equal(found["CryptoMaterial00"], [[[float_id("all"), 0.5, 0, 0], [0, 0, 0, 0]]])
    assert not found["CryptoMaterial01"].any()


# Deep

DEEP = dict.fromkeys("RGBA", "float") | {"Z": "float", "particleid": "uint"}


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


# Compression


@pytest.mark.parametrize("compression", LOSSLESS)
def test_lossless_compressions_hold_the_same_pixels(picture, tmp_path, compression):
    usual = channels_of(write(tmp_path / "zips", picture)[0])
    path, deep = write(tmp_path / "other", picture, compression=compression)
    (spec,) = parts_of(path)
    assert spec["compression"] == compression
    found = channels_of(path)
    assert found.keys() == usual.keys()
    assert all(bits(found[name]) == bits(values) for name, values in usual.items())
    assert parts_of(deep)[0]["compression"] == "zips"


@pytest.mark.parametrize("compression", LOSSY)
def test_lossy_compressions_touch_colours_only(picture, tmp_path, compression):
    usual = channels_of(write(tmp_path / "zips", picture)[0])
    path, _ = write(tmp_path / "lossy", picture, compression=compression)
    color, data = parts_of(path)
    assert (color["compression"], data["compression"]) == (compression, "zips")
    assert types_of(color) == HALF
    found = channels_of(path)
    exact = {name: values for name, values in usual.items() if name not in HALF}
    assert set(types_of(data)) == set(exact)
    for name, values in exact.items():
        assert bits(found[f"data.front/{name}"]) == bits(values), name
    for name in HALF:
        difference = found[f"rgba.front/{name}"].astype(np.float32) - usual[name].astype(np.float32)
        assert np.abs(difference).mean() < 1e-3, name
    assert any(bits(found[f"rgba.front/{name}"]) != bits(usual[name]) for name in HALF) or (
        compression == "pxr24"  # which keeps half floats
    )


@pytest.mark.parametrize("layers", [("Z", "id", "crypto"), ("motion",)])
def test_data_alone_is_lossless_whatever_is_asked_for(picture, tmp_path, layers):
    usual, lossy = (
        write(tmp_path / kind, picture, layers=layers, compression=kind)[0] for kind in ("zips", "dwaa")
    )
    assert [spec["compression"] for spec in parts_of(lossy)] == ["zips"]
    expected, found = channels_of(usual), channels_of(lossy)
    assert all(bits(found[name]) == bits(values) for name, values in expected.items())


# Colour


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


# Header


@pytest.mark.parametrize(
    ("frame", "fps", "rate", "code"),
    [
        (1001, 24.0, (24, 1), (0, 0, 41, 17)),
        (0, 24.0, (24, 1), (0, 0, 0, 0)),
        (24 * 3661 + 5, 24.0, (24, 1), (1, 1, 1, 5)),
        (24 * 86400 + 7, 24.0, (24, 1), (0, 0, 0, 7)),
        # NTSC's frames are counted as if they were whole.
        (1001, 23.976, (24000, 1001), (0, 0, 41, 17)),
        (1001, 24000 / 1001, (24000, 1001), (0, 0, 41, 17)),
        (1019, 29.97, (30000, 1001), (0, 0, 33, 29)),
        (1024, 25.0, (25, 1), (0, 0, 40, 24)),
        # Above thirty a second, time codes count in twos or more: they have no more numbers.
        (1007, 48.0, (48, 1), (0, 0, 20, 23)),
        (1007, 59.94, (60000, 1001), (0, 0, 16, 23)),
        (1079, 60.0, (60, 1), (0, 0, 17, 29)),
        (1079, 120.0, (120, 1), (0, 0, 8, 29)),
        (-3, 24.0, (24, 1), (0, 0, 0, 0)),
    ],
)
def test_the_header_tells_the_time(small, tmp_path, frame, fps, rate, code):
    picture = flat_picture(torch.ones(3), torch.tensor(1.0), small)
    (path,) = write(tmp_path, dataclasses.replace(picture, frame=frame, fps=fps), layers=("rgba",))
    header = header_of(path)
    assert header["framesPerSecond"] == Fraction(*rate)
    assert header["imageCounter"] == frame
    stored = header["timeCode"]
    assert (stored.hours, stored.minutes, stored.seconds, stored.frame) == code
    assert header["dsar/frame"] == str(frame)
    assert float(header["dsar/seconds"]) == pytest.approx(frame * rate[1] / rate[0], abs=1e-5)
    (spec,) = parts_of(path)
    assert spec.getattribute("framesPerSecond") == rate
    packed = spec.getattribute("smpte:TimeCode")[0]
    # Binary-coded decimals: tens of hours, minutes, seconds and frames have two or three bits.
    fields = ((24, 3), (16, 7), (8, 7), (0, 3))
    digits = (10 * (packed >> shift + 4 & tens) + (packed >> shift & 15) for shift, tens in fields)
    assert tuple(digits) == code


def test_the_header_tells_shutter_and_exposure(take, small, tmp_path):
    sharp = flat_picture(torch.ones(3), torch.tensor(1.0), small)
    (path,) = write(tmp_path / "sharp", sharp, layers=("rgba",))
    header = header_of(path)
    assert header["dsar/shutter"] == "0 0"
    assert "expTime" not in header
    assert "shutterAngle" not in header
    blurred = take(aovs=("rgba",), motion_samples=2, shutter=(-0.25, 0.25), fps=24.0)
    (path,) = write(tmp_path / "blurred", blurred, layers=("rgba",))
    (spec,) = parts_of(path)
    assert spec["shutterAngle"] == pytest.approx(180.0)
    assert header_of(path)["expTime"] == pytest.approx(0.5 / 24)
    assert spec["dsar/shutter"] == "-0.25 0.25"


def test_the_header_tells_the_lens(cameras, tmp_path):
    for camera in cameras:
        (path,) = write(tmp_path, flat_picture(torch.ones(3), torch.tensor(1.0), camera), layers=("rgba",))
        (spec,) = parts_of(path)
        width, height = spec["sensorOverallDimensions"]
        focal = spec["pinholeFocalLength"]
        assert width == 36
        assert focal / width * camera.width == pytest.approx(float(camera.K[0, 0]))
        assert focal / height * camera.height == pytest.approx(float(camera.K[1, 1]))


def test_every_part_says_where_it_comes_from(picture, side, tmp_path):
    paths = write(tmp_path, picture, side, views="multipart", compression="dwaa")
    for path in paths:
        for part in range(len(parts_of(path))):
            header = header_of(path, part)
            assert {key: header[f"dsar/{key}"] for key in PROVENANCE} == PROVENANCE
            assert header["cameraLabel"] == header["view"]
            assert header["dsar/job"] == f"job of {header['view']}"
            assert header["software"] == "dsar 0.1"


# What is there already


@pytest.fixture(params=["zips", "dwaa", "multipart"])
def written(request, picture, side, tmp_path) -> tuple[ExrSequence, list[Path]]:
    """Two views with deep files, and a third's folder of which nothing is asked."""
    how = {"views": "multipart"} if request.param == "multipart" else {"compression": request.param}
    sequence = ExrSequence(tmp_path, layers=("rgba", "Z", "id"), **how)
    return sequence, sequence.write([picture, side], ["job a", "job b"])


def complete(
    sequence: ExrSequence, *, frame=1003, cameras=("front", "side"), jobs=("job a", "job b"), deep=True
):
    return sequence.complete(frame, cameras, jobs, deep)


def test_what_was_written_is_complete(written):
    sequence, _ = written
    assert complete(sequence)
    assert complete(sequence, deep=False)
    assert complete(sequence, cameras=("side", "front"), jobs=("job b", "job a"))


def test_files_of_other_jobs_frames_and_cameras_do_not_count(written):
    sequence, _ = written
    assert not complete(sequence, jobs=("job a", "job c"))
    assert not complete(sequence, jobs=("job b", "job a"))
    assert not complete(sequence, jobs=("job a", ""))
    assert not complete(sequence, frame=1004)
    assert not complete(sequence, cameras=("front", "back"))
    assert not complete(dataclasses.replace(sequence, name="other"))
    assert not complete(dataclasses.replace(sequence, folder=sequence.folder / "other"))


def test_a_missing_file_is_noticed(written):
    sequence, paths = written
    for path in paths:
        content = path.read_bytes()
        path.unlink()
        assert not complete(sequence)
        assert complete(sequence, deep=False) == ("_deep" in path.name)
        path.write_bytes(content)
    assert complete(sequence)


def test_a_file_that_is_cut_off_anywhere_is_noticed(written, capfd):
    sequence, paths = written
    for path in paths:
        content = path.read_bytes()
        size = len(content)
        for length in (0, 1, 4, 300, size // 10, size // 3, size // 2, 9 * size // 10, size - 40, size - 1):
            path.write_bytes(content[:length])
            assert not complete(sequence), (path.name, length, size)
        path.write_bytes(content)
    assert complete(sequence)
    # OpenEXR says on its own channels what it found.
    capfd.readouterr()


def test_something_else_in_a_files_place_is_noticed(written):
    sequence, paths = written
    for content in (b"", b"not an image at all", b"\x76\x2f\x31\x01", bytes(5000)):
        paths[0].write_bytes(content)
        assert not complete(sequence)
    paths[0].unlink()
    paths[0].mkdir()
    assert not complete(sequence)


def test_an_image_of_one_camera_in_the_folder_of_another_is_noticed(picture, side, tmp_path):
    sequence = ExrSequence(tmp_path, layers=("rgba",))
    one, two, *_ = sequence.write([picture, side], ["job", "job"])
    assert complete(sequence, jobs=("job", "job"))
    one.write_bytes(two.read_bytes())
    assert not complete(sequence, jobs=("job", "job"))


def test_other_settings_are_other_jobs(tmp_path):
    base = {"folder": tmp_path, "layers": ("rgba", "Z")}
    others = [
        {"name": "other"},
        {"layers": ("rgba",)},
        {"layers": ("Z", "rgba")},
        {"compression": "zip"},
        {"views": "multipart"},
        {"crop": True},
        {"target": ColorTarget("ACEScg")},
    ]
    keys = [ExrSequence(**(base | each)).key for each in ({}, *others)]
    assert len(set(keys)) == len(keys)
    # Where they are written is no matter: a farm's machines mount folders where they like.
    assert ExrSequence(**(base | {"folder": tmp_path / "elsewhere"})).key == keys[0]


@pytest.mark.parametrize(
    "settings",
    [{}, {"compression": "dwaa"}, {"views": "multipart", "crop": True}, {"compression": "piz"}],
    ids=str,
)
def test_the_same_picture_makes_the_same_bytes(picture, side, tmp_path, settings):
    one, two = (write(tmp_path / name, picture, side, **settings) for name in ("one", "two"))
    assert [path.read_bytes() for path in one] == [path.read_bytes() for path in two]
    again = write(tmp_path / "one", picture, side, **settings)
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in two]


# PNG


def pngs(folder: Path, *pictures: Picture) -> tuple[PngSequence, list[Path]]:
    sequence = PngSequence(folder, "anna")
    return sequence, sequence.write(pictures, [f"job of {picture.camera.name}" for picture in pictures])


def test_pngs_are_complete_when_they_are_whole_and_of_this_job(picture, side, tmp_path):
    sequence, paths = pngs(tmp_path, picture, side)
    assert [str(path.relative_to(tmp_path)) for path in paths] == [
        "front/anna.front.1003.png",
        "side/anna.side.1003.png",
    ]
    jobs = ["job of front", "job of side"]
    assert sequence.complete(1003, ["front", "side"], jobs, False)
    assert sequence.complete(1003, ["front", "side"], jobs, True)
    assert not sequence.complete(1003, ["front", "side"], jobs[::-1], False)
    assert not sequence.complete(1004, ["front"], jobs[:1], False)
    assert not sequence.complete(1003, ["back"], jobs[:1], False)
    assert not PngSequence(tmp_path, "other").complete(1003, ["front"], jobs[:1], False)
    assert sequence.key != PngSequence(tmp_path, "other").key


def test_a_png_that_is_cut_off_anywhere_is_noticed(picture, tmp_path):
    sequence, (path,) = pngs(tmp_path, picture)
    content = path.read_bytes()
    size = len(content)
    for length in (0, 1, 8, 33, 100, size // 4, size // 2, size - 500, size - 20, size - 12, size - 1):
        path.write_bytes(content[:length])
        assert not sequence.complete(1003, ["front"], ["job of front"], False), (length, size)
    path.write_bytes(b"nothing like it")
    assert not sequence.complete(1003, ["front"], ["job of front"], False)
    path.write_bytes(content)
    assert sequence.complete(1003, ["front"], ["job of front"], False)


def test_the_same_picture_makes_the_same_png(picture, tmp_path):
    one, two = (pngs(tmp_path / name, picture)[1][0].read_bytes() for name in ("one", "two"))
    assert one == two


def test_a_png_shows_the_cameras_view_without_the_overscan(picture, wide, tmp_path):
    sharp, ample = (
        np.asarray(Image.open(pngs(tmp_path / str(each.overscan), each)[1][0])) for each in (picture, wide)
    )
    assert sharp.shape == ample.shape == (256, 192, 4)
    assert np.abs(sharp[..., 3].astype(int) - ample[..., 3]).max() <= 1
