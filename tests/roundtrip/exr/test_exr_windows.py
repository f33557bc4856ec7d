"""Where things are: data windows, overscan, crops, and the header's matrices."""

import dataclasses
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from exr_files import (
    DEEP,
    channels_of,
    header_of,
    parts_of,
    types_of,
    unprefixed,
    write,
)

from dsar.geometry.cameras import project
from dsar.types import Gaussians
from dsar_exporters import ColorTarget, ExrSequence
from dsar_render.triplets import FrameTriplet


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
        picture = take(view, FrameTriplet(1003, thing), aovs=("rgba", "Z", "P"), overscan=overscan)
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
    assert ExrSequence(tmp_path).is_complete(1003, ["front"], ["job of front"], True)
