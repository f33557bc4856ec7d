from collections.abc import Callable
from pathlib import Path

import gsply
import numpy as np
import plyfile
import pytest
import torch

from dsar.errors import ExportError
from dsar.types import Gaussians, GaussianSequence
from dsar_exporters import read_ply, write_ply


def _first_frame(sequence: GaussianSequence) -> Gaussians:
    return next(iter(sequence))[1]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 7])
def test_reading_back_gives_the_gaussians_that_were_written(make_sequence, tmp_path, count, degree):
    sequence = make_sequence(count, degree, frames=1)
    [path] = write_ply(sequence, tmp_path, name="avatar")
    expected, found = _first_frame(sequence), read_ply(path)
    for name, values in vars(expected).items():
        # exp(log(x)) and sigmoid(logit(x)) lose a few float32 digits.
        torch.testing.assert_close(getattr(found, name), values, rtol=1e-5, atol=1.1e-6, msg=name)


def test_every_frame_is_a_file_with_its_number(make_sequence, tmp_path):
    paths = write_ply(make_sequence(frames=3, step=2), tmp_path / "ply", name="avatar")
    assert [path.name for path in paths] == ["avatar.1001.ply", "avatar.1003.ply", "avatar.1005.ply"]
    assert sorted((tmp_path / "ply").iterdir()) == paths


def test_plyfile_sees_the_property_order_and_encoding_of_3dgs(make_sequence, tmp_path):
    sequence = make_sequence(3, degree=1, frames=1)
    [path] = write_ply(sequence, tmp_path, name="avatar")
    gaussians = _first_frame(sequence)
    ply = plyfile.PlyData.read(path, mmap=False)
    vertices = ply["vertex"].data
    assert list(vertices.dtype.names) == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(9)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    assert {vertices.dtype[i] for i in range(len(vertices.dtype))} == {np.dtype("<f4")}
    # Channel-major: red of the three coefficients of degree 1, then green, then blue.
    np.testing.assert_array_equal(vertices["f_rest_1"], gaussians.harmonics[:, 2, 0])
    np.testing.assert_array_equal(vertices["f_rest_3"], gaussians.harmonics[:, 1, 1])
    np.testing.assert_array_equal(vertices["rot_0"], gaussians.rotations[:, 0])
    np.testing.assert_allclose(vertices["scale_1"], gaussians.scales[:, 1].log(), rtol=1e-6)
    np.testing.assert_allclose(vertices["opacity"], gaussians.opacities.logit(), rtol=1e-5, atol=1e-6)
    assert {
        "dsar.frame 1001",
        "dsar.fps 24",
        "dsar.units m",
        "dsar.colorspace srgb_rec709_display",
        "dsar.motion swing",
        "Vertical axis: 0 1 0",
    } <= set(ply.comments)


@pytest.mark.parametrize("degree", [0, 3])
def test_gsply_reads_the_same_values(make_sequence, tmp_path, degree):
    sequence = make_sequence(6, degree, frames=1)
    [path] = write_ply(sequence, tmp_path, name="avatar")
    gaussians, found = _first_frame(sequence), gsply.plyread(path)
    np.testing.assert_array_equal(found.means, gaussians.means)
    np.testing.assert_array_equal(found.quats, gaussians.rotations)
    np.testing.assert_array_equal(found.sh0, gaussians.harmonics[:, 0])
    np.testing.assert_allclose(np.exp(found.scales), gaussians.scales, rtol=1e-5)
    if degree:
        np.testing.assert_array_equal(found.shN, gaussians.harmonics[:, 1:])


def test_normals_may_be_missing_and_quaternions_of_any_length(make_sequence, tmp_path):
    [path] = write_ply(make_sequence(4, degree=1, frames=1), tmp_path, name="avatar")
    vertices = plyfile.PlyData.read(path, mmap=False)["vertex"].data
    kept = [name for name in vertices.dtype.names if name[0] != "n"]
    foreign = np.empty(len(vertices), [(name, "f4") for name in reversed(kept)])
    for name in kept:
        foreign[name] = vertices[name] * (3 if name.startswith("rot") else 1)
    other = tmp_path / "foreign.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(foreign, "vertex")], text=True).write(other)
    for name, values in vars(read_ply(path)).items():
        torch.testing.assert_close(getattr(read_ply(other), name), values, msg=name)


def test_zero_scale_and_full_opacity_are_written_finite(make_sequence, tmp_path):
    def change(_: int, gaussians: Gaussians) -> Gaussians:
        flat = torch.zeros_like(gaussians.scales)
        extreme = torch.tensor([0.0, 1.0])
        return Gaussians(gaussians.means, gaussians.rotations, flat, extreme, gaussians.harmonics)

    [path] = write_ply(make_sequence(2, frames=1, change=change), tmp_path, name="avatar")
    vertices = plyfile.PlyData.read(path, mmap=False)["vertex"].data
    assert all(np.isfinite(vertices[name]).all() for name in vertices.dtype.names)
    torch.testing.assert_close(read_ply(path).opacities, torch.tensor([0.0, 1.0]), rtol=0, atol=1.1e-6)


def test_padding_adds_zero_harmonics_and_never_cuts(make_sequence, tmp_path):
    [path] = write_ply(make_sequence(2, degree=0, frames=1), tmp_path, name="avatar", sh_degree=3)
    harmonics = read_ply(path).harmonics
    assert harmonics.shape == (2, 16, 3)
    assert not harmonics[:, 1:].any()
    with pytest.raises(ExportError, match="sh_degree: expected at least"):
        write_ply(make_sequence(2, degree=1, frames=1), tmp_path, name="cut", sh_degree=0)


def test_a_failing_frame_leaves_the_earlier_files_and_no_partial_one(breaking_sequence, tmp_path):
    with pytest.raises(RuntimeError, match="the network failed"):
        write_ply(breaking_sequence, tmp_path, name="avatar")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["avatar.1001.ply", "avatar.1002.ply"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda g: g.map(lambda values: values[:2]), "frame 1001: expected 5 Gaussians, found 2"),
        (lambda g: g.map(lambda values: values / 0), "frame 1001: expected finite means, found 15 values"),
    ],
    ids=["another count", "not finite"],
)
def test_an_unfit_frame_is_refused_by_number(
    make_sequence: Callable[..., GaussianSequence], tmp_path: Path, change, message
):
    sequence = make_sequence(change=lambda _, gaussians: change(gaussians))
    with pytest.raises(ExportError, match=message):
        write_ply(sequence, tmp_path, name="avatar")
    assert not list(tmp_path.iterdir())


def test_a_ply_that_is_no_splat_is_refused_by_its_missing_properties(tmp_path):
    path = tmp_path / "points.ply"
    vertices = np.zeros(2, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")]).write(path)
    with pytest.raises(ExportError, match=r"found a point cloud, which has no properties f_dc_0, .*opacity"):
        read_ply(path)
    with pytest.raises(ExportError, match="expected a PLY"):
        read_ply(tmp_path / "missing.ply")
