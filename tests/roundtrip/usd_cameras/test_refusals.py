"""Cameras and files that are refused, by name."""

from pathlib import Path

import pytest
from pxr import Gf, UsdGeom
from usd_stages import FRAMES, SIZE, add_camera, read

from dsar.errors import ExportError
from dsar_exporters import list_usd_cameras, read_usd_cameras


def _mirror(camera: UsdGeom.Camera) -> None:
    UsdGeom.Xformable(camera).AddScaleOp().Set(Gf.Vec3f(-1, 1, 1))


def _stretch(camera: UsdGeom.Camera) -> None:
    UsdGeom.Xformable(camera).AddScaleOp().Set(Gf.Vec3f(1, 1, 1.01))


def _flatten(camera: UsdGeom.Camera) -> None:
    UsdGeom.Xformable(camera).AddScaleOp().Set(Gf.Vec3f(0, 0, 0))


def _shear(camera: UsdGeom.Camera) -> None:
    matrix = Gf.Matrix4d(1)
    matrix[0, 1] = 0.1
    UsdGeom.Xformable(camera).AddTransformOp().Set(matrix)


def _flat_lens(camera: UsdGeom.Camera) -> None:
    camera.GetHorizontalApertureAttr().Set(0.0)


def _orthographic(camera: UsdGeom.Camera) -> None:
    camera.CreateProjectionAttr("orthographic")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_mirror, r"found it mirrored, stretched or sheared .* determinant -1\): take the scale off"),
        (_stretch, r"lengths of its axes 1, 1, 1\.01; determinant 1\.01"),
        (_flatten, r"lengths of its axes 0, 0, 0; determinant 0"),
        (_shear, "mirrored, stretched or sheared"),
        (
            _flat_lens,
            "expected focalLength, horizontalAperture and verticalAperture > 0, found 35, 0 and 13.5",
        ),
        (_orthographic, "expected a perspective camera, found an orthographic one: make it perspective"),
    ],
)
def test_a_camera_that_is_none_of_ours_is_refused_by_name(make_stage, spoil, message):
    stage = make_stage()
    add_camera(stage, "/world/sound")
    spoil(add_camera(stage, "/world/shot"))
    with pytest.raises(ExportError, match=rf"stage\.usda, camera /world/shot: .*{message}"):
        read(stage)


def test_without_a_resolution_it_is_asked_for(make_stage):
    stage = make_stage()
    add_camera(stage, "/shot")
    with pytest.raises(ExportError, match=r"camera /shot: expected a resolution, .* give --res WIDTH HEIGHT"):
        read(stage, resolution=None)


def test_only_chosen_cameras_are_judged_and_all_have_names(make_stage):
    stage = make_stage()
    add_camera(stage, "/world/shotCam")
    _orthographic(add_camera(stage, "/world/top"))
    _mirror(add_camera(stage, "/world/mirror"))
    stage.Save()
    path = Path(stage.GetRootLayer().realPath)
    assert list_usd_cameras(path) == ["shotCam", "top", "mirror"]
    how = {"frames": FRAMES, "resolution": SIZE}
    (found,) = read_usd_cameras(path, **how, chosen=["shotCam"])
    assert found.name == "shotCam"
    with pytest.raises(
        ExportError, match=r"camera /world/top: .* orthographic .* choose others with --camera"
    ):
        read_usd_cameras(path, **how)


def test_what_is_no_stage_with_cameras_is_refused(make_stage, tmp_path):
    stage = make_stage()
    UsdGeom.Xform.Define(stage, "/empty")
    with pytest.raises(ExportError, match=r"stage\.usda: expected cameras, found none"):
        read(stage)
    with pytest.raises(ExportError, match="expected a USD file with cameras, found none: give its path"):
        read_usd_cameras(tmp_path / "missing.usda", frames=FRAMES)
    (tmp_path / "wrong.usda").write_text("nothing")
    with pytest.raises(
        ExportError, match=r"wrong\.usda: expected a USD file, found one that starts with b'noth'"
    ):
        read_usd_cameras(tmp_path / "wrong.usda", frames=FRAMES)
