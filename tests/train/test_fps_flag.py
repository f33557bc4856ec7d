"""`--fps`: files at other rates than the avatar's tell the same seconds, and say their rate."""

import dataclasses
import json
import struct
from fractions import Fraction
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
import torch
from exr_files import header_of
from PIL import Image
from plyfile import PlyData
from pxr import Usd, UsdGeom

from dsar.cli import main
from dsar.data.captures.formats import open_capture
from dsar.geometry.camera_files import write_cameras_json
from dsar.geometry.camera_paths import CameraPath
from dsar.geometry.cameras import project

RATES = [("24", 8, 24.0), ("23.976", 8, 24000 / 1001), ("60000/1001", 18, 60000 / 1001)]
"""Rate as given, frames of 10 at 30 a second, rate that is meant."""


def command(*arguments) -> None:
    main([*map(str, arguments), "--progress", "none"])


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def positions(path: Path, seconds: float) -> np.ndarray:
    """Return where a viewer has the instances at a time, as it interpolates between samples."""
    stage = Usd.Stage.Open(str(path))
    (instancer,) = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.PointInstancer)]
    time = 1001 + seconds * stage.GetTimeCodesPerSecond()
    return np.array(UsdGeom.PointInstancer(instancer).GetPositionsAttr().Get(time))


@pytest.fixture(scope="module")
def usual(trained, tmp_path_factory) -> Path:
    """The motion at the avatar's own rate."""
    folder = tmp_path_factory.mktemp("usual")
    command("export", trained, "--usd", folder / "a.usdc", "--ply", folder / "ply")
    return folder


@pytest.mark.parametrize(("text", "frames", "fps"), RATES)
def test_a_stage_at_another_rate_shows_the_same_at_the_same_seconds(
    trained, usual, tmp_path, text, frames, fps
):
    command("export", trained, "--fps", text, "--usd", tmp_path / "a.usdc", "--json", tmp_path / "j")
    facts = json.loads((tmp_path / "j").read_text())
    assert (facts["frames"], facts["fps"]) == (frames, fps)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert (stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()) == (fps, fps)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1001, 1000 + frames)
    for frame in range(frames):
        found, expected = (positions(folder / "a.usdc", frame / fps) for folder in (tmp_path, usual))
        # Between samples viewers go straight: of 50 m/s² a hand has here, they miss a dt² / 8, 7 mm at most.
        assert np.linalg.norm(found - expected, axis=1).max() < 7e-3
    assert np.array_equal(positions(tmp_path / "a.usdc", 0), positions(usual / "a.usdc", 0))
    (instancer,) = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.PointInstancer)]
    instances = UsdGeom.PointInstancer(instancer)
    places, speeds = instances.GetPositionsAttr(), instances.GetVelocitiesAttr()
    for frame in range(1001, 1000 + frames):
        moved = (np.array(places.Get(frame + 1)) - np.array(places.Get(frame))) * fps
        assert np.allclose(speeds.Get(frame), moved, atol=1e-4)


def test_splats_and_their_manifest_say_their_rate(trained, usual, tmp_path):
    command("export", trained, "--fps", "23.98", "--ply", tmp_path / "ply")
    (first, *_) = sorted((tmp_path / "ply").iterdir())
    comments = PlyData.read(str(first)).comments
    assert [line for line in comments if line.startswith("dsar.fps")] == ["dsar.fps 23.976"]
    found, before = (json.loads((folder / "ply.manifest.json").read_text()) for folder in (tmp_path, usual))
    assert found["frames"]["range"] == "1001-1008"
    assert found["frames"]["fps"] == 24000 / 1001
    assert found["provenance"] == {**before["provenance"], "fps": "24000/1001"}


def test_the_avatars_own_rate_changes_no_byte(trained, usual, tmp_path):
    command("export", trained, "--fps", "30.0", "--ply", tmp_path / "ply", "--usd", tmp_path / "a.usdc")
    assert contents(tmp_path) == contents(usual)


def test_images_at_another_rate_are_the_same_in_chunks_and_say_their_rate(trained, tmp_path):
    blur = ("--motion-samples", 2, "--shutter", 0, 0.5)
    shot = ("render", trained, "--camera", "cam0", "--aov", "rgba,motion", *blur)
    command(*shot, "--fps", "23.976", "--exr", tmp_path / "whole")
    whole = contents(tmp_path / "whole")
    assert len(whole) == 8
    for chunk in ("1001-1004", "1005-1008"):
        command(*shot, "--fps", "24000/1001", "--exr", tmp_path / "chunks", "--frames", chunk)
    assert contents(tmp_path / "chunks") == whole
    header = header_of(tmp_path / "whole/cam0/avatar.cam0.1003.exr")
    assert header["framesPerSecond"] == Fraction(24000, 1001)
    assert header["expTime"] == pytest.approx(0.5 * 1001 / 24000)
    assert header["dsar/fps"] == "24000/1001"
    # Frames of another rate under the same names are none of this job's.
    again = ("--frames", "1003", "--skip-existing", "--json", tmp_path / "j")
    command(*shot, "--fps", "24", "--exr", tmp_path / "chunks", *again)
    assert json.loads((tmp_path / "j").read_text())["skipped"] == 0
    other = header_of(tmp_path / "chunks/cam0/avatar.cam0.1003.exr")
    assert other["framesPerSecond"] == Fraction(24)
    assert other["dsar/job"] != header["dsar/job"]


@pytest.mark.parametrize(("fps", "frame"), [("15", 1003), ("60", 1009)])
def test_motion_vectors_go_to_the_next_delivered_frame(trained, tiny_capture, tmp_path, fps, frame):
    command(
        "export", trained, "--fps", fps, "--ply", tmp_path / "ply", "--frames", f"{frame - 1}-{frame + 1}"
    )
    shot = ("--camera", "cam0", "--aov", "rgba,motion,id", "--frames", frame)
    command("render", trained, "--fps", fps, "--exr", tmp_path / "exr", *shot)
    image = oiio.ImageBuf(str(tmp_path / f"exr/cam0/avatar.cam0.{frame}.exr"))
    names = image.spec().channelnames
    pixels = image.get_pixels(oiio.FLOAT)
    (camera,) = [each for each in open_capture(tiny_capture).cameras if each.name == "cam0"]
    with OpenEXR.File(str(tmp_path / f"exr/cam0/avatar.cam0.{frame}.exr"), separate_channels=True) as file:
        ids = file.channels()["id"].pixels.astype(np.int64)
    shown = ids < 2**32 - 1

    def places(number: int) -> np.ndarray:
        points = PlyData.read(str(tmp_path / f"ply/avatar.{number}.ply"))["vertex"]
        means = torch.from_numpy(np.stack([points["x"], points["y"], points["z"]], -1))
        return project(camera, means)[0].numpy()[ids[shown]] * [1, -1]

    for layer, number in (("forward", frame + 1), ("backward", frame - 1)):
        found = np.stack([pixels[..., names.index(f"{layer}.{axis}")][shown] for axis in "uv"], -1)
        expected = places(number) - places(frame)
        # A pixel shows its neighbours, too.
        assert np.median(np.linalg.norm(found - expected, axis=1)) < 0.1 * np.median(
            np.linalg.norm(expected, axis=1)
        )


def test_a_video_plays_at_the_rate_and_as_long_as_the_motion(trained, tmp_path):
    command("render", trained, "--fps", "59.94", "--mp4", tmp_path / "a.mp4", "--camera", "cam0")
    content = (tmp_path / "a.mp4").read_bytes()
    (timescale,) = struct.unpack_from(">I", content, content.index(b"mdhd") + 16)
    frames, duration = struct.unpack_from(">II", content, content.index(b"stts") + 12)
    assert (Fraction(timescale, duration), frames) == (Fraction(60000, 1001), 18)


def test_cameras_move_by_seconds_whatever_is_delivered(trained, tiny_capture, tmp_path):
    start, *_, end = open_capture(tiny_capture).cameras
    rig = CameraPath((start, dataclasses.replace(end, name=start.name)), (1001, 1009))
    path = write_cameras_json([rig], tmp_path / "rig.json")
    path.write_text(json.dumps({"fps": 30, **json.loads(path.read_text())}))
    made = ("--camera", "cam0,turntable", "--cameras", path)
    # A sixth of a second: the fourth frame of 24 and the fifth of 30.
    for fps, frame in (("24", 1005), ("30", 1006)):
        command("render", trained, "--fps", fps, "--png", tmp_path / fps, *made, "--frames", frame)
    for camera in ("cam0", "turntable"):
        one, two = (
            np.asarray(Image.open(tmp_path / fps / camera / f"avatar.{camera}.{frame}.png")).astype(int)
            for fps, frame in (("24", 1005), ("30", 1006))
        )
        assert one[..., 3].max() > 200
        assert np.abs(one - two).max() <= 1


def test_a_stages_camera_at_the_rate_of_delivery_moves_with_it(trained, tmp_path):
    command("export", trained, "--fps", "24", "--usd", tmp_path / "a.usda")
    shot = ("--fps", "24", "--camera", "turntable", "--frames", "1006", "--res", 48, 64)
    command("render", trained, "--png", tmp_path / "made", *shot)
    command("render", trained, "--png", tmp_path / "read", "--cameras", tmp_path / "a.usda", *shot)
    made, read = (
        np.asarray(Image.open(tmp_path / name / "turntable/avatar.turntable.1006.png")).astype(int)
        for name in ("made", "read")
    )
    assert made[..., 3].max() > 200
    assert np.abs(made - read).max() <= 2


def test_a_farms_job_keeps_the_rate(trained, tmp_path):
    job = tmp_path / "job.json"
    command(
        "render", trained, "--fps", "24000/1001", "--exr", tmp_path / "exr", "--openjd", job, "--chunk", 3
    )
    (step,) = json.loads(job.read_text())["steps"]
    arguments = step["script"]["actions"]["onRun"]["args"]
    assert arguments[arguments.index("--fps") + 1] == "24000/1001"
    (ranges,) = step["parameterSpace"]["taskParameterDefinitions"]
    assert ranges["range"] == ["1001-1003", "1004-1006", "1007-1008"]


@pytest.mark.parametrize("text", ["nan", "0", "-24", "1e6"])
@pytest.mark.parametrize("verb", ["export", "render"])
def test_what_is_no_rate_is_one_line_and_writes_nothing(trained, tmp_path, capsys, verb, text):
    flag = "--ply" if verb == "export" else "--png"
    with pytest.raises(SystemExit) as stop:
        command(verb, trained, f"--fps={text}", flag, tmp_path / "out")
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith(f"dsar: --fps {text}: expected frames per second from 1 to 1000")
    assert message.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_frames_are_counted_at_the_rate_of_delivery(trained, tmp_path, capsys):
    command("export", trained, "--fps", "60", "--ply", tmp_path / "ply", "--frames", "1019")
    assert [path.name for path in (tmp_path / "ply").iterdir()] == ["avatar.1019.ply"]
    with pytest.raises(SystemExit):
        command("export", trained, "--fps", "24", "--ply", tmp_path / "ply", "--frames", "1009")
    assert "which has frames 1001-1008 at 24 a second" in capsys.readouterr().err
