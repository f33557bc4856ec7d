"""Faults of the values in a PLY: each is told, once, by its true name."""

import re
from collections.abc import Callable

import numpy as np
import pytest
from splat_files import COUNT, retyped, save

from dsar_exporters import find_faults


def logarithms_to_metres(vertices: np.ndarray) -> None:
    for name in ("scale_0", "scale_1", "scale_2"):
        vertices[name] = np.exp(vertices[name])


def to_millimetres(vertices: np.ndarray) -> None:
    for name in "xyz":
        vertices[name] *= 1000
    for name in ("scale_0", "scale_1", "scale_2"):
        vertices[name] += np.log(1000)


def logits_to_opacities(vertices: np.ndarray) -> None:
    vertices["opacity"] = 1 / (1 + np.exp(-vertices["opacity"]))


def colors_to_bytes(vertices: np.ndarray) -> None:
    for name in ("f_dc_0", "f_dc_1", "f_dc_2"):
        vertices[name] = np.random.default_rng(1).integers(0, 256, COUNT)


def set_to(name: str, value: float, count: int = 1) -> Callable[[np.ndarray], None]:
    def spoil(vertices: np.ndarray) -> None:
        vertices[name][:count] = value

    return spoil


def no_quaternions(vertices: np.ndarray) -> None:
    for name in ("rot_0", "rot_1", "rot_2", "rot_3"):
        vertices[name][:7] = 0


def all_at_one_place_half_in_metres(vertices: np.ndarray) -> None:
    for name in "xyz":
        vertices[name] = 0
    for name in ("scale_0", "scale_1", "scale_2"):
        vertices[name][: COUNT // 2] = 0.02


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (set_to("opacity", np.inf, 50), "expected finite opacity, found 50 inf among 400 values"),
        (set_to("opacity", -np.inf), "expected finite opacity, found 1 -inf among"),
        (set_to("scale_2", -np.inf, 50), "expected finite scale_2, found 50 -inf among 400 values"),
        (set_to("scale_0", np.inf), "expected finite scale_0, found 1 inf"),
        (set_to("x", np.nan, 2), "expected finite x, found 2 NaN"),
        (set_to("rot_3", np.nan), "expected finite rot_3, found 1 NaN"),
        (set_to("f_dc_1", np.inf), "expected finite f_dc_1, found 1 inf"),
        (logarithms_to_metres, "found 0.00.* which look like metres, not logarithms: all 400"),
        (all_at_one_place_half_in_metres, "found 200 of 400 .*up to 1.02: their scale_. look like metres"),
        (set_to("scale_1", 6.0), r"smaller than their cloud of [45]\.\d+, found 1 of 400 .* up to 403"),
        (set_to("scale_1", 1000.0), "found 1 of 400 with standard deviations up to inf"),
        (
            logits_to_opacities,
            "expected logits in opacity, found 400 values from 0.00.*, as if they were opacities",
        ),
        (colors_to_bytes, "expected harmonics in f_dc_.* are they bytes"),
        (set_to("f_dc_0", 1e6), r"expected colours near 0 to 1 from f_dc_\*, found 1 of 1200 beyond 100"),
        (no_quaternions, "expected quaternions in rot_., found 7 of 400 of length 0"),
    ],
)
def test_a_raw_fault_is_the_only_one_told(cloud, tmp_path, spoil, message):
    spoil(cloud)
    (fault,) = find_faults(save(tmp_path / "a.ply", cloud))
    assert re.search(message, fault), fault


@pytest.mark.parametrize(
    ("change", "how"),
    [
        (lambda vertices: None, {}),
        (lambda vertices: None, {"text": True}),
        (lambda vertices: None, {"byte_order": ">"}),
        (to_millimetres, {}),
        (set_to("opacity", 40.0), {}),
        (set_to("x", 300.0), {"comments": ["a floater"]}),
    ],
    ids=["plain", "text", "big-endian", "millimetres", "opaque", "floater"],
)
def test_what_is_sound_has_no_faults(cloud, tmp_path, change, how):
    change(cloud)
    assert find_faults(save(tmp_path / "a.ply", cloud, **how)) == []
    doubles = retyped(cloud, lambda name: "<f8")
    assert find_faults(save(tmp_path / "b.PLY", doubles, **how)) == []


def test_clouds_too_small_to_compare_are_not_judged_by_size(cloud, tmp_path):
    cloud["scale_0"] = 0.5
    assert find_faults(save(tmp_path / "a.ply", cloud[:3])) == []


def test_bytes_after_the_last_gaussian_are_a_fault_and_nothing_is_one_too(cloud, tmp_path):
    path = save(tmp_path / "a.ply", cloud)
    path.write_bytes(path.read_bytes().replace(b"vertex 400", b"vertex 300"))
    assert find_faults(path) == [
        "expected the file to end after the 300 Gaussians of its header, found 5600 bytes more"
    ]
    assert find_faults(save(path, cloud[:0])) == ["expected Gaussians, found none"]
