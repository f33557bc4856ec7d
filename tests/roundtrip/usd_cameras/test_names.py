"""Which prims of a stage are cameras, and how they are called."""

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom
from usd_stages import add_camera, pixels, read, usd_pixels


def add_pair(stage: Usd.Stage, path: str, data: str, *, moved: bool = True, called: bool = False) -> None:
    """An object and its data as two prims."""
    parent = UsdGeom.Xform.Define(stage, path)
    if moved:
        parent.AddTranslateOp().Set(Gf.Vec3d(0, 0, 500))
    if called:
        name = "userProperties:blender:object_name"
        parent.GetPrim().CreateAttribute(name, Sdf.ValueTypeNames.String).Set("shot.001")
    UsdGeom.Camera.Define(stage, f"{path}/{data}")


def test_cameras_are_called_as_their_objects_and_never_alike(make_stage):
    stage = make_stage()
    add_pair(stage, "/root/shot_010", "Camera_001")
    add_pair(stage, "/root/unmoved", "Camera_002", moved=False, called=True)
    add_pair(stage, "/World", "hero", moved=False)
    add_pair(stage, "/pair", "left")
    UsdGeom.Camera.Define(stage, "/pair/right")
    for path in ("/a/main", "/b/main", "/c/x/main", "/d/x/main", "/a_main"):
        add_camera(stage, path)
    names = [each.name for each in read(stage)]
    expected = ["shot_010", "unmoved", "hero", "left", "right", "a_main", "b_main", "c_x_main", "d_x_main"]
    assert names == [*expected, "a_main_2"]


def test_a_camera_that_blender_calls_a_transform_is_read_and_the_file_left_alone(make_stage):
    stage = make_stage()
    camera = add_camera(stage, "/root/shot")
    camera.GetFocalLengthAttr().Clear()
    expected = usd_pixels(stage, "/root/shot", 1001)
    UsdGeom.Xform.Define(stage, "/root/shot")
    UsdGeom.Xform.Define(stage, "/root/other").AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    (found,) = read(stage)
    assert np.abs(pixels(found.at(1001)) - expected).max() < 0.01
    assert stage.GetPrimAtPath("/root/shot").GetTypeName() == "Xform"


def test_cameras_of_instances_are_read_and_inactive_ones_are_not(make_stage):
    stage = make_stage()
    add_camera(stage, "/off").GetPrim().SetActive(False)
    add_camera(stage, "/_set/witness")
    stage.GetPrimAtPath("/_set").SetSpecifier(Sdf.SpecifierClass)
    for index in range(2):
        prim = UsdGeom.Xform.Define(stage, f"/copy{index}").GetPrim()
        prim.GetReferences().AddInternalReference("/_set")
        prim.SetInstanceable(True)
    assert [each.name for each in read(stage)] == ["copy0_witness", "copy1_witness"]
