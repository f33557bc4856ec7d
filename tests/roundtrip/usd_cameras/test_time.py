"""When a camera of a stage moves: keys, frames at rest, and rates other than ours."""

import numpy as np
import pytest
import torch
from pxr import Gf, UsdGeom
from usd_stages import FRAMES, add_camera, read

from dsar.errors import ExportError


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


def test_a_camera_that_moves_at_other_frames_is_at_rest_with_a_warning(make_stage, caplog):
    stage = make_stage()
    place = UsdGeom.Xformable(add_camera(stage, "/shot")).GetOrderedXformOps()[0]
    for frame in (1, 250):
        place.Set(Gf.Vec3d(frame, 0, 500), frame)
    (found,) = read(stage)
    assert found.frames == ()
    assert "camera /shot: moves at 1 to 250, stands still at 1000 to 1007" in caplog.text


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
