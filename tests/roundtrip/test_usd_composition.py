"""Faults are found wherever a stage draws them from, and what it misses or cannot open is named."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils, Vt

from dsar.errors import ExportError
from dsar_exporters import find_faults

TYPES = Sdf.ValueTypeNames
BAD = "/a/g: expected opacities from 0 to 1, found 2.2 to 2.2"


def make_stage(path: Path, **metadata) -> Usd.Stage:
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, metadata.get("unit", 1.0))
    UsdGeom.SetStageUpAxis(stage, metadata.get("up", "Y"))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/a").GetPrim())
    return stage


def add_field(stage: Usd.Stage, opacity: float, path: str = "/a/g") -> Usd.Prim:
    field = stage.DefinePrim(path, "ParticleField3DGaussianSplat")
    for name, type_name, value in (
        ("positions", TYPES.Point3fArray, [(0, 0, 0)]),
        ("scales", TYPES.Float3Array, [(0.02, 0.02, 0.02)]),
        ("orientations", TYPES.QuatfArray, Vt.QuatfArray([Gf.Quatf(1)])),
        ("opacities", TYPES.FloatArray, [opacity]),
        ("extent", TYPES.Float3Array, [(-1, -1, -1), (1, 1, 1)]),
    ):
        field.CreateAttribute(name, type_name).Set(value)
    return field


@pytest.fixture
def folder(tmp_path) -> Path:
    """A folder with a sound and a faulty stage."""
    for name, opacity in (("good", 0.9), ("bad", 2.2)):
        stage = make_stage(tmp_path / f"{name}.usda")
        add_field(stage, opacity)
        stage.Save()
    return tmp_path


def compose(
    folder: Path, compose_it: Callable[[Usd.Stage], object], name: str = "shot.usda", **metadata
) -> Path:
    stage = make_stage(folder / name, **metadata)
    compose_it(stage)
    stage.Save()
    return folder / name


def _refer(stage: Usd.Stage, path: str, asset: str, *, instance: bool = False) -> None:
    prim = stage.DefinePrim(path)
    prim.GetReferences().AddReference(asset)
    prim.SetInstanceable(instance)


def _three_instances(stage: Usd.Stage) -> None:
    for name in ("one", "three", "two"):
        _refer(stage, f"/a/{name}", "./bad.usda", instance=True)


def _below_an_instancer(stage: Usd.Stage) -> None:
    instancer = UsdGeom.PointInstancer.Define(stage, "/a/many")
    instancer.CreatePositionsAttr([(0, 0, 0)])
    instancer.CreateProtoIndicesAttr([0])
    instancer.CreateExtentAttr([(-1, -1, -1), (1, 1, 1)])
    instancer.CreatePrototypesRel().SetTargets(["/a/many/prototype"])
    _refer(stage, "/a/many/prototype", "./bad.usda", instance=True)


@pytest.mark.parametrize(
    ("compose_it", "where"),
    [
        (lambda stage: _refer(stage, "/a/x", "./bad.usda"), "/a/x/g"),
        (lambda stage: _refer(stage, "/a/x", "./bad.usda", instance=True), "/a/x/g"),
        (lambda stage: stage.DefinePrim("/a/x").GetPayloads().AddPayload("./bad.usda"), "/a/x/g"),
        (_three_instances, "/a/one/g and 2 instances more"),
        (_below_an_instancer, "/a/many/prototype/g"),
        (lambda stage: stage.GetRootLayer().subLayerPaths.append("./bad.usda"), "/a/g"),
    ],
    ids=["reference", "instance", "payload", "instances", "prototype", "sublayer"],
)
def test_a_fault_is_found_once_wherever_it_comes_from(folder, compose_it, where):
    shot = compose(folder, compose_it)
    expected = [f"{where}: expected opacities from 0 to 1, found 2.2 to 2.2"]
    assert find_faults(shot) == expected
    nested = compose(
        folder, lambda stage: _refer(stage, "/a/deep", "./shot.usda", instance=True), "film.usda"
    )
    assert find_faults(nested) == [expected[0].replace("/a/", "/a/deep/", 1)]


def test_a_package_is_looked_into(folder):
    shot = compose(folder, _three_instances)
    assert UsdUtils.CreateNewUsdzPackage(str(shot), str(folder / "shot.USDZ"))
    assert [fault for fault in find_faults(folder / "shot.USDZ") if "opacities" in fault] == [
        "/a/one/g and 2 instances more: expected opacities from 0 to 1, found 2.2 to 2.2"
    ]


def test_what_is_not_drawn_is_not_judged_and_units_may_differ(folder):
    def compose_it(stage: Usd.Stage) -> None:
        _refer(stage, "/a/x", "./good.usda", instance=True)
        _refer(stage, "/a/off", "./bad.usda")
        stage.GetPrimAtPath("/a/off").SetActive(False)

    assert find_faults(compose(folder, compose_it, unit=0.01, up="Z")) == []


@pytest.mark.parametrize("name", ["opacities", "scales", "extent"])
def test_a_fault_in_one_sample_of_any_field_is_found(folder, name):
    path = compose(folder, lambda stage: add_field(stage, 0.5))
    stage = Usd.Stage.Open(str(path))
    attribute = stage.GetPrimAtPath("/a/g").GetAttribute(name)
    sound = attribute.Get()
    faulty = {
        "opacities": [2.2],
        "scales": [(-0.02, 0.02, 0.02)],
        "extent": [(float("nan"), 0, 0), (1, 1, 1)],
    }
    for time, value in ((1001, sound), (1002, faulty[name]), (1003, sound)):
        attribute.Set(value, time)
    stage.Save()
    (fault,) = find_faults(path)
    assert fault.startswith("/a/g at 1002: expected")


def test_an_extent_of_one_corner_is_a_fault(folder):
    path = compose(folder, lambda stage: add_field(stage, 0.5).GetAttribute("extent").Set([(1, 1, 1)]))
    assert find_faults(path) == ["/a/g: expected an extent of two finite corners, found [[1.0, 1.0, 1.0]]"]


@pytest.mark.parametrize(
    "compose_it",
    [
        lambda stage: _refer(stage, "/a/m", "./nowhere.usda"),
        lambda stage: stage.DefinePrim("/a/m").GetPayloads().AddPayload("./nowhere.usda"),
        lambda stage: stage.GetRootLayer().subLayerPaths.append("./nowhere.usda"),
    ],
    ids=["reference", "payload", "sublayer"],
)
def test_a_missing_file_is_a_fault_that_names_it_and_the_terminal_stays_quiet(folder, compose_it, capfd):
    def with_the_good_one(stage: Usd.Stage) -> None:
        _refer(stage, "/a/x", "./good.usda")
        compose_it(stage)

    path = compose(folder, with_the_good_one)
    capfd.readouterr()
    faults = find_faults(path)
    assert faults
    assert all("nowhere.usda" in fault for fault in faults)
    assert capfd.readouterr().err == ""


def test_a_broken_file_that_a_stage_depends_on_is_a_fault(folder):
    Usd.Stage.Open(str(folder / "bad.usda")).Export(str(folder / "whole.usdc"))
    (folder / "cut.usdc").write_bytes((folder / "whole.usdc").read_bytes()[:1000])
    path = folder / "shot.usda"
    path.write_text('#usda 1.0\ndef "a" (references = @./cut.usdc@)\n{\n}\n')
    assert any(re.search(r"one that it depends on broken: .*cut\.usdc", fault) for fault in find_faults(path))
    with pytest.raises(
        ExportError, match=r"cut\.usdc: expected a USD file, found one that USD cannot open: .*10"
    ):
        find_faults(folder / "cut.usdc")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.usda", b"", "found an empty file"),
        ("a.usd", b"", "found an empty file"),
        ("a.usdc", b"nonsense", "found one that starts with b'nons'"),
        ("a.usdz", b"nonsense", "found one that starts with b'nons'"),
        ("a.USDA", b"PXR-USDC and more", "a .usdc file under a .usda file's name: rename it"),
        ("a.usda", b'#usda 1.0\ndef "a" {', "one that USD cannot open: .*a.usda:2"),
    ],
)
def test_what_usd_cannot_open_is_one_true_line(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ExportError, match=message) as refused:
        find_faults(tmp_path / name)
    assert "\n" not in str(refused.value)
