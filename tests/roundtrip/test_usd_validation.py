"""Faults put into a sound asset are found, by the writer's own check and by `find_faults`."""

import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pxr
import pytest
from pxr import Usd, UsdGeom, UsdVol, Vt

from dsar.errors import ExportError
from dsar.types import GaussianSequence
from dsar_exporters import find_faults, write_ply, write_usd
from dsar_exporters.usd.validation import refuse_faults


@pytest.fixture
def asset(make_sequence: Callable[..., GaussianSequence], tmp_path: Path) -> Path:
    return write_usd(make_sequence(), tmp_path / "avatar.usda", name="avatar")


def _instancer(stage: Usd.Stage) -> UsdGeom.PointInstancer:
    return UsdGeom.PointInstancer.Get(stage, "/full/instancer")


def _splats(stage: Usd.Stage) -> UsdVol.ParticleField3DGaussianSplat:
    return UsdVol.ParticleField3DGaussianSplat.Get(stage, "/full/splats")


def _shorten_positions(stage: Usd.Stage) -> None:
    positions = _instancer(stage).GetPositionsAttr()
    positions.Set(positions.Get(1004)[:3], 1004)


def _shorten_velocities(stage: Usd.Stage) -> None:
    velocities = _instancer(stage).GetVelocitiesAttr()
    velocities.Set(velocities.Get(1002)[:3], 1002)


def _shorten_colors(stage: Usd.Stage) -> None:
    UsdGeom.PrimvarsAPI(_splats(stage)).GetPrimvar("displayColor").Set(Vt.Vec3fArray(2))


def _lose_harmonics(stage: Usd.Stage) -> None:
    _splats(stage).GetRadianceSphericalHarmonicsCoefficientsAttr().Set(Vt.Vec3fArray(4))


def _break_a_position(stage: Usd.Stage) -> None:
    positions = _splats(stage).GetPositionsAttr()
    values = np.array(positions.Get(1003))
    values[2, 1] = np.nan
    positions.Set(Vt.Vec3fArray.FromNumpy(values), 1003)


def _stretch_a_quaternion(stage: Usd.Stage) -> None:
    rotations = _splats(stage).GetOrientationsAttr()
    rotations.Set(Vt.QuatfArray.FromNumpy(2 * np.array(rotations.Get(1002))), 1002)


def _flatten_a_scale(stage: Usd.Stage) -> None:
    scales = _splats(stage).GetScalesAttr()
    scales.Set(Vt.Vec3fArray.FromNumpy(0 * np.array(scales.Get(1002))))


def _overdo_an_opacity(stage: Usd.Stage) -> None:
    opacities = _splats(stage).GetOpacitiesAttr()
    opacities.Set(Vt.FloatArray.FromNumpy(np.array(opacities.Get(1002)) + 0.9))


def _shrink_an_extent(stage: Usd.Stage) -> None:
    extent = _splats(stage).GetExtentAttr()
    extent.Set(Vt.Vec3fArray.FromNumpy(0.9 * np.array(extent.Get(1002))), 1002)


def _lose_an_extent(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/full/instancer").RemoveProperty("extent")


def _repeat_an_id(stage: Usd.Stage) -> None:
    _instancer(stage).GetIdsAttr().Set(Vt.Int64Array([0, 1, 2, 3, 3]))


def _point_to_no_prototype(stage: Usd.Stage) -> None:
    _instancer(stage).GetProtoIndicesAttr().Set(Vt.IntArray([0, 0, 0, 0, 1]))


def _swap_units(stage: Usd.Stage) -> None:
    opacities = _splats(stage).GetOpacitiesAttr()
    values = np.clip(np.array(opacities.Get(1001)), 0.01, 0.9)
    opacities.Set(Vt.FloatArray.FromNumpy(np.log(values / (1 - values))))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_shorten_positions, r"instancer \(lod full\) at 1004: expected 5 positions, found 3"),
        (_shorten_velocities, r"instancer \(lod full\) at 1002: expected 5 velocities, found 3"),
        (_shorten_colors, "expected 5 primvars:displayColor, found 2"),
        (_lose_harmonics, "expected 5 harmonics, found 4"),
        (_break_a_position, r"splats \(lod full\) at 1003: expected finite positions, found 1 values"),
        (_stretch_a_quaternion, "at 1002: expected unit quaternions, found lengths (2|1.99)"),
        (_flatten_a_scale, "expected scales above 0, found 0"),
        (_overdo_an_opacity, "expected opacities from 0 to 1"),
        (_swap_units, "expected opacities from 0 to 1, found -"),
        (_shrink_an_extent, "at 1002: expected an extent that holds 3 standard deviations"),
        (_lose_an_extent, "expected an extent, found none"),
        (_repeat_an_id, "expected each id once, found 1 again"),
        (_point_to_no_prototype, "expected protoIndices below 1, found 0 to 1"),
    ],
)
def test_a_spoiled_asset_is_caught(asset, spoil, message):
    assert find_faults(asset) == []
    stage = Usd.Stage.Open(str(asset.with_suffix(".payload.usdc")))
    spoil(stage)
    stage.Save()
    del stage
    assert any(re.search(message, fault) for fault in find_faults(asset))


def test_every_level_of_detail_is_checked(asset):
    stage = Usd.Stage.Open(str(asset.with_suffix(".payload.usdc")))
    positions = UsdGeom.PointInstancer.Get(stage, "/quarter/instancer").GetPositionsAttr()
    positions.Set(Vt.Vec3fArray(1), 1002)
    stage.Save()
    del stage
    (fault,) = find_faults(asset)
    assert "(lod quarter) at 1002: expected 2 positions, found 1" in fault


def test_usds_own_validators_are_run(make_sequence, tmp_path):
    path = write_usd(make_sequence(), tmp_path / "avatar.usdc", name="avatar")
    stage = Usd.Stage.Open(str(path))
    stage.ClearMetadata("metersPerUnit")
    stage.Save()
    del stage
    assert any("metersPerUnit" in fault for fault in find_faults(path))
    with pytest.raises(ExportError, match="metersPerUnit"):
        refuse_faults(path, [1001, 1004])


def test_a_file_of_others_is_checked_too(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "theirs.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/theirs")
    stage.SetDefaultPrim(splats.GetPrim())
    splats.CreatePositionshAttr(Vt.Vec3hArray(2))
    splats.CreateOrientationshAttr(Vt.QuathArray.FromNumpy(np.tile([0, 0, 0, 1], (2, 1)).astype(np.float16)))
    splats.CreateScaleshAttr(Vt.Vec3hArray.FromNumpy(np.full((2, 3), 0.01, np.float16)))
    stage.Save()
    (fault,) = find_faults(tmp_path / "theirs.usda")
    assert "/theirs: expected an extent, found none" in fault
    splats.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.array([[-1] * 3, [1] * 3], np.float32)))
    stage.Save()
    assert find_faults(tmp_path / "theirs.usda") == []


def test_instancers_of_other_things_are_checked_for_what_holds_for_all(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "cubes.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    cubes = UsdGeom.PointInstancer.Define(stage, "/cubes")
    stage.SetDefaultPrim(cubes.GetPrim())
    cube = UsdGeom.Cube.Define(stage, "/cubes/cube")
    cube.CreateExtentAttr(UsdGeom.Cube.ComputeExtentFromPlugins(cube, 1.0))
    cubes.CreatePrototypesRel().SetTargets([cube.GetPath()])
    for time, count in ((1, 2), (2, 3)):
        cubes.CreatePositionsAttr().Set(Vt.Vec3fArray(count), time)
        cubes.CreateProtoIndicesAttr().Set(Vt.IntArray(count), time)
        cubes.CreateExtentAttr().Set(cubes.ComputeExtentAtTime(time, time), time)
    stage.Save()
    assert find_faults(tmp_path / "cubes.usda") == []
    cubes.CreateScalesAttr().Set(Vt.Vec3fArray(2))
    stage.Save()
    assert find_faults(tmp_path / "cubes.usda") == ["/cubes at 2: expected 3 scales, found 2"]


@pytest.mark.parametrize("name", ["a.compressed.ply", "a.ply"])
@pytest.mark.parametrize(
    "content", [b"ply\nformat binary_little_endian 1.0\nelement chu", b"ply\ncomment \xff\n"]
)
def test_a_ply_cut_in_its_header_is_refused(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ExportError, match="expected a"):
        find_faults(tmp_path / name)


def test_harmonics_of_no_degree_are_refused(make_sequence, tmp_path):
    import plyfile

    (path,) = write_ply(make_sequence(degree=1, frames=1), tmp_path, name="a")
    element = plyfile.PlyData.read(path, mmap=False)["vertex"].data
    names = [name for name in element.dtype.names if name not in ("f_rest_8", "f_rest_7", "f_rest_6")]
    fewer = plyfile.PlyElement.describe(
        np.ascontiguousarray(element[names]).astype([(n, "<f4") for n in names]), "vertex"
    )
    plyfile.PlyData([fewer]).write(path)
    with pytest.raises(ExportError, match="expected 0, 9, 24 or 45 properties f_rest_"):
        find_faults(path)


def test_a_usd_file_without_gaussians_says_so(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    stage.Save()
    assert "nothing in it is ours" in find_faults(tmp_path / "a.usda")[-1]


def test_a_usd_core_without_validators_is_reported(asset, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "pxr.UsdValidation", None)
    monkeypatch.delattr(pxr, "UsdValidation", raising=False)
    refuse_faults(asset, [1001])
    assert "validators were not run" in caplog.text
    asset.with_suffix(".payload.usdc").unlink()
    assert any(re.match(r"CompositionError: .*avatar\.payload\.usdc", fault) for fault in find_faults(asset))


@pytest.mark.parametrize("name", ["a.usda", "a.usdc", "a.ply", "a.spz", "a.compressed.ply"])
def test_what_is_no_such_file_is_refused(tmp_path, name):
    with pytest.raises(ExportError, match="expected a file to check, found none"):
        find_faults(tmp_path / name)
    (tmp_path / name).write_bytes(b"nonsense")
    with pytest.raises(ExportError, match=r"expected"):
        find_faults(tmp_path / name)


def test_a_file_of_another_kind_is_refused(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0")
    with pytest.raises(ExportError, match=r"expected .*\.spz, found \.obj"):
        find_faults(tmp_path / "a.obj")
