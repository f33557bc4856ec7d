"""Cameras read from USD project as those that were written, and as USD's own frustum does."""

import numpy as np
import pytest
import torch
from pxr import Gf, Usd, UsdGeom
from usd_stages import FRAMES, SIZE, add_camera, pixels, read, usd_pixels

from dsar.geometry.camera_paths import turntable
from dsar_exporters import read_usd_cameras, write_usd


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


def test_a_stage_without_a_unit_is_read_in_centimetres_with_a_warning(make_stage, caplog):
    stage = make_stage(unit=None)
    add_camera(stage, "/shot")
    assert np.isclose(read(stage)[0].at(1001).center[1], 5.0)
    assert "says no metersPerUnit; read in centimetres" in caplog.text


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
