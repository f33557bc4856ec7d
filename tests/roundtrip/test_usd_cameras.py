"""Cameras read from USD project as those that were written, and as USD's own frustum does."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Gf, Sdf, Usd, UsdGeom

from dsar.errors import ExportError
from dsar.geometry.camera_paths import CameraPath, turntable
from dsar.geometry.cameras import project
from dsar.types import Camera
from dsar_exporters import list_usd_cameras, read_usd_cameras, write_usd

FRAMES = range(1001, 1007)
SIZE = (1920, 1080)
POINTS = torch.rand(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
Stages = Callable[..., Usd.Stage]


@pytest.fixture
def make_stage(tmp_path: Path) -> Stages:
    """Make a stage as others do: centimetres, Z up, 24 a second."""

    def make(
        name: str = "stage.usda", up: str = "Z", unit: float | None = 0.01, rate: float = 24.0
    ) -> Usd.Stage:
        stage = Usd.Stage.CreateNew(str(tmp_path / name))
        UsdGeom.SetStageUpAxis(stage, up)
        if unit is not None:
            UsdGeom.SetStageMetersPerUnit(stage, unit)
        stage.SetTimeCodesPerSecond(rate)
        return stage

    return make


def add_camera(stage: Usd.Stage, path: str, *, shift: float = 0.0) -> UsdGeom.Camera:
    """A 16:9 lens, five metres off in centimetres, looking at the origin along its -Z."""
    camera = UsdGeom.Camera.Define(stage, path)
    camera.CreateFocalLengthAttr(35.0)
    camera.CreateHorizontalApertureAttr(24.0)
    camera.CreateVerticalApertureAttr(13.5)
    camera.CreateHorizontalApertureOffsetAttr(shift)
    camera.CreateVerticalApertureOffsetAttr(-0.5 * shift)
    UsdGeom.Xformable(camera).AddTranslateOp().Set(Gf.Vec3d(10, 20, 500))
    return camera


def read(stage: Usd.Stage, frames=FRAMES, resolution=SIZE, fps=24.0) -> list[CameraPath]:
    stage.Save()
    path = Path(stage.GetRootLayer().realPath)
    return read_usd_cameras(path, frames=frames, resolution=resolution, fps=fps)


def usd_pixels(stage: Usd.Stage, path: str, time: float, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Project as USD does; of our metres and Y up it makes the stage's."""
    frustum = UsdGeom.Camera.Get(stage, path).GetCamera(time).frustum
    matrix = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
    points = POINTS.numpy() / UsdGeom.GetStageMetersPerUnit(stage)
    if UsdGeom.GetStageUpAxis(stage) == "Z":
        points = points @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    clip = np.concatenate([points, np.ones((len(points), 1))], 1) @ matrix
    return (clip[:, :2] / clip[:, 3:] * [1, -1] + 1) / 2 * np.array(size)


def pixels(camera: Camera) -> np.ndarray:
    found, depth = project(camera, POINTS)
    assert (depth > 0).all()
    return found.numpy()


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_our_own_cameras_come_back_to_a_hundredth_of_a_pixel(figure, front, cameras, suffix, tmp_path):
    # `cameras` have oblong pixels, all of them a principal point off the centre.
    rig = [front, *cameras]
    path = write_usd(figure, tmp_path / f"anna{suffix}", name="anna", cameras=rig)
    found = read_usd_cameras(path, frames=FRAMES, fps=24.0)
    assert [each.name for each in found] == ["front", "cam00", "cam01", "turntable"]
    *still, moving = found
    for one, two in zip(still, rig, strict=True):
        assert one.frames == ()
        camera = one.at(1003)
        assert (camera.width, camera.height) == (two.width, two.height)
        assert np.abs(pixels(camera) - pixels(two)).max() < 0.01
        assert torch.allclose(camera.K, two.K, rtol=1e-5)
    circling = turntable(figure.binding, FRAMES, 24.0, width=front.width, height=front.height)
    assert moving.frames == tuple(range(1000, 1008))
    for time in (*np.linspace(1001, 1006, 21), 900, 2000):
        assert np.abs(pixels(moving.at(float(time))) - pixels(circling.at(float(time)))).max() < 0.01


def test_our_own_cameras_read_at_another_resolution_see_the_same(figure, cameras, tmp_path):
    path = write_usd(figure, tmp_path / "anna.usda", name="anna", cameras=cameras)
    found = read_usd_cameras(path, frames=[1001], resolution=(1280, 960))
    for one, two in zip(found, cameras, strict=False):
        assert np.abs(pixels(one.at(1001)) - pixels(two.resized(1280, 960))).max() < 0.05


def test_a_camera_under_a_moving_scaled_parent_is_where_usd_has_it(make_stage):
    stage = make_stage()
    rig = UsdGeom.Xform.Define(stage, "/world/rig")
    rig.AddScaleOp().Set(Gf.Vec3f(1.5))
    spin, lift = rig.AddRotateXYZOp(), rig.AddTranslateOp()
    for frame in (1001, 1004, 1006):
        spin.Set(Gf.Vec3f(70.0, 3.0, 10.0 * (frame - 1001)), frame)
        lift.Set(Gf.Vec3d(0, frame - 1001, 4), frame)
    add_camera(stage, "/world/rig/shot", shift=1.7)
    zoom = add_camera(stage, "/world/zoom").GetFocalLengthAttr()
    UsdGeom.Xformable(stage.GetPrimAtPath("/world")).AddRotateXOp().Set(2.0)
    for frame in (1001, 1006):
        zoom.Set(30.0 + (frame - 1001), frame)
    found = read(stage)
    assert [each.name for each in found] == ["shot", "zoom"]
    for each, path in zip(found, ("/world/rig/shot", "/world/zoom"), strict=True):
        assert each.frames == tuple(range(1000, 1008))
        for frame in FRAMES:
            assert np.abs(pixels(each.at(frame)) - usd_pixels(stage, path, frame)).max() < 0.01
    middle = (found[0].at(1002).center + found[0].at(1003).center) / 2
    assert torch.allclose(found[0].at(1002.5).center, middle)


@pytest.mark.parametrize(("up", "unit"), [("Y", 1.0), ("Y", 0.0254), ("Z", 1.0), ("Z", 0.001)])
def test_units_and_axes_are_the_stages(make_stage, up, unit):
    stage = make_stage(up=up, unit=unit)
    camera = add_camera(stage, "/shot", shift=-2.0)
    place = UsdGeom.Xformable(camera).GetOrderedXformOps()[0]
    ours = np.array([1.0, 0.5, 4.0])
    place.Set(Gf.Vec3d(*(ours / unit if up == "Y" else ours[[0, 2, 1]] * [1, -1, 1] / unit)))
    if up == "Z":
        UsdGeom.Xformable(camera).AddRotateXOp().Set(90.0)
    view = read(stage)[0].at(1001)
    assert np.allclose(view.center, ours, atol=1e-6)
    assert np.allclose(view.T_camera_world[:3, :3], np.diag([1, -1, -1]), atol=1e-6)
    assert np.abs(pixels(view) - usd_pixels(stage, "/shot", 1001)).max() < 0.01


def test_frames_with_a_step_are_keyed_with_their_neighbours(make_stage):
    stage = make_stage()
    place = UsdGeom.Xformable(add_camera(stage, "/shot")).GetOrderedXformOps()[0]
    for frame in (1, 100):
        place.Set(Gf.Vec3d(frame, 0, 500), frame)
    (found,) = read(stage, frames=[10, 20])
    assert found.frames == (9, 10, 11, 19, 20, 21)


def test_what_keeps_its_place_is_at_rest_whatever_the_rate(make_stage):
    stage = make_stage()
    place = UsdGeom.Xformable(add_camera(stage, "/still")).GetOrderedXformOps()[0]
    for frame in (1001, 1003, 1010):
        place.Set(Gf.Vec3d(10, 20, 500), frame)
    # Blender writes what stands still as one sample, and nothing at the default time.
    single = add_camera(stage, "/single").GetFocalLengthAttr()
    single.Clear()
    single.Set(60.0, 1)
    still, single = read(stage, fps=30.0)
    assert still.frames == single.frames == ()
    assert np.isclose(single.at(1001).K[0, 0], 1920 * 60 / 24)


def test_a_picture_that_is_not_the_aperture_has_its_width_and_square_pixels(make_stage):
    stage = make_stage()
    add_camera(stage, "/shot", shift=2.0)
    (found,) = read(stage, resolution=(1000, 1000))
    K = found.at(1001).K
    focal = 1000 * 35 / 24
    expected = [[focal, 0, 500 - 2 * focal / 35], [0, focal, 500 - focal / 35], [0, 0, 1]]
    assert np.allclose(K, expected, rtol=1e-6)
    # usdrecord widens or narrows the vertical aperture in the same way.
    UsdGeom.Camera.Get(stage, "/shot").GetVerticalApertureAttr().Set(24.0)
    assert np.abs(pixels(found.at(1001)) - usd_pixels(stage, "/shot", 1001, (1000, 1000))).max() < 0.01


def test_a_picture_within_a_hundredth_of_the_aperture_shows_all_of_it(make_stage):
    stage = make_stage()
    add_camera(stage, "/shot", shift=2.0)
    (found,) = read(stage, resolution=(1920, 1088))
    assert np.abs(pixels(found.at(1001)) - usd_pixels(stage, "/shot", 1001, (1920, 1088))).max() < 0.01


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


def test_a_camera_that_moves_at_other_frames_is_at_rest_with_a_warning(make_stage, caplog):
    stage = make_stage()
    place = UsdGeom.Xformable(add_camera(stage, "/shot")).GetOrderedXformOps()[0]
    for frame in (1, 250):
        place.Set(Gf.Vec3d(frame, 0, 500), frame)
    (found,) = read(stage)
    assert found.frames == ()
    assert "camera /shot: moves at 1 to 250, stands still at 1000 to 1007" in caplog.text


def test_a_stage_without_a_unit_is_read_in_centimetres_with_a_warning(make_stage, caplog):
    stage = make_stage(unit=None)
    add_camera(stage, "/shot")
    assert np.isclose(read(stage)[0].at(1001).center[1], 5.0)
    assert "says no metersPerUnit; read in centimetres" in caplog.text


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


@pytest.mark.parametrize(("rate", "fps"), [(24.0, 30.0), (60.0, 25.0), (24000 / 1001, 25.0)])
def test_a_camera_of_another_rate_is_taken_by_seconds_from_frame_1001(make_stage, caplog, rate, fps):
    stage = make_stage(rate=rate)
    place = UsdGeom.Xformable(add_camera(stage, "/shot")).GetOrderedXformOps()[0]
    for time in (951, 1101):
        place.Set(Gf.Vec3d(2 * (time - 1001) / rate * 100, 0, 500), time)
    with caplog.at_level("INFO"):
        (path,) = read(stage, fps=fps)
    # Two metres a second, whatever counts the time; before the first frame too, where a shutter opens.
    for frame in (1001, 1002, 1004, 1006, 1000.75, 1003.5):
        center = (-path.at(frame).T_camera_world[:3, :3].T @ path.at(frame).T_camera_world[:3, 3])[0]
        assert center == pytest.approx(2 * (frame - 1001) / fps, abs=1e-6)
    (record,) = [record for record in caplog.records if "by seconds" in record.message]
    assert f"moves at {rate:g} time codes a second, taken by seconds for {fps:g} frames" in record.message
    assert record.message.endswith("frame 1001 is time code 1001")


def test_a_camera_of_another_rate_that_has_come_to_rest_is_where_it_came_to_rest(make_stage, caplog):
    stage = make_stage(rate=120.0)
    place = UsdGeom.Xformable(add_camera(stage, "/shot")).GetOrderedXformOps()[0]
    for time in (1001, 1021):
        place.Set(Gf.Vec3d(time - 1001, 0, 0), time)
    # Frame 1010 is time code 1046 there, while time code 1010 is on the way.
    (path,) = read(stage, frames=[1010], fps=24.0)
    assert path.frames == ()
    assert "moves at 1001 to 1021, stands still at 1041 to 1052" in caplog.text
    center = -path.cameras[0].T_camera_world[:3, :3].T @ path.cameras[0].T_camera_world[:3, 3]
    assert center[0] == pytest.approx(0.2)


def test_a_turning_camera_of_another_rate_turns_and_is_not_sheared(make_stage):
    stage = make_stage(up="Y", rate=24.0)
    camera = UsdGeom.Xformable(UsdGeom.Camera.Define(stage, "/shot"))
    turning = camera.AddTransformOp()
    for time in range(1000, 1010):
        turn = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(0, 1, 0), 20.0 * (time - 1001)))
        turning.Set(turn, time)
    (path,) = read(stage, fps=30.0)
    for frame in FRAMES:
        angle = np.radians(20.0 * (frame - 1001) * 24 / 30)
        backwards = path.at(frame).T_camera_world[2, :3] * -1
        expected = torch.tensor([np.sin(angle), 0.0, np.cos(angle)])
        torch.testing.assert_close(backwards, expected.float(), rtol=0, atol=1e-6)


def test_equal_rates_and_stages_that_say_none_count_frames(make_stage, caplog):
    stage = make_stage(rate=23.976)
    place = UsdGeom.Xformable(add_camera(stage, "/shot")).GetOrderedXformOps()[0]
    for frame in (1001, 1006):
        place.Set(Gf.Vec3d(frame, 0, 500), frame)
    with caplog.at_level("INFO"):
        assert read(stage, fps=24000 / 1001)[0].frames == tuple(range(1000, 1008))
        assert read(stage, fps=None)[0].frames == tuple(range(1000, 1008))
        # Who says nothing of a rate counts frames.
        stage.GetRootLayer().ClearTimeCodesPerSecond()
        assert read(stage, fps=30.0)[0].frames == tuple(range(1000, 1008))
        stage.SetFramesPerSecond(60.0)
        assert read(stage, fps=30.0)[0].frames[:2] == (1000.0, 1000.5)
    assert [record.message.count("by seconds") for record in caplog.records] == [1]


def test_a_rate_that_is_none_is_refused_where_a_camera_moves(make_stage):
    stage = make_stage(rate=-24.0)
    place = UsdGeom.Xformable(add_camera(stage, "/shot")).GetOrderedXformOps()[0]
    assert read(stage, fps=30.0)[0].frames == ()
    for frame in (1001, 1006):
        place.Set(Gf.Vec3d(frame, 0, 500), frame)
    with pytest.raises(ExportError, match="camera /shot: expected time codes per second > 0, found -24"):
        read(stage, fps=30.0)


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


def test_a_camera_of_ours_under_anothers_lens_is_read_by_its_aperture(figure, front, tmp_path):
    path = write_usd(figure, tmp_path / "anna.usda", name="anna", cameras=[front])
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.GetRootLayer().subLayerPaths.append(str(path))
    camera = UsdGeom.Camera(stage.OverridePrim("/anna/cameras/front"))
    camera.GetHorizontalApertureAttr().Set(0.36)
    camera.GetVerticalApertureAttr().Set(0.2025)
    found = read(stage)[0].at(1001)
    assert (found.width, found.height) == SIZE
    assert np.abs(pixels(found) - usd_pixels(stage, "/anna/cameras/front", 1001)).max() < 0.01
