"""`dsar render`: the same files whoever draws them, and whatever happens on the way."""

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from dsar.cli import main
from dsar.data.captures.formats import open_capture
from dsar.geometry.camera_files import write_cameras_json
from dsar.geometry.camera_paths import CameraPath

SHOT = (
    *("--frames", "1001-1010", "--camera", "cam0,turntable", "--res", "192", "256"),
    *("--aov", "rgba,Z,N,P,motion,id,crypto", "--deep"),
)


def render(run, folder, *more, shot=SHOT):
    main([*map(str, ("render", run, "--exr", folder, *shot, *more)), "--progress", "none"])


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files of a folder that nobody writes to any more, hidden ones too."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def images(folder: Path) -> list[Path]:
    """Return the finished images, also while others are being written.

    Drafts are hidden folders that come and go; a search that enters them may find one gone.
    """
    return list(folder.glob("*/[!.]*.exr"))


@contextlib.contextmanager
def spawned(run, folder, *more):
    """Run a render in a process of its own, which does not outlive the block."""
    arguments = [sys.executable, "-m", "dsar", "render", run, "--exr", folder, *SHOT, *more]
    paths = {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(
        [*map(str, arguments), "--progress", "none"], env=os.environ | paths, stderr=subprocess.PIPE
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


def wait_for_images(folder: Path, count: int, process: subprocess.Popen) -> None:
    while len(images(folder)) < count:
        assert process.poll() is None, "the run ended before it could be disturbed"
        time.sleep(0.01)


def children(process: int) -> list[int]:
    listed = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [int(child) for child in listed if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


@pytest.fixture(scope="module")
def whole(trained, tmp_path_factory) -> dict[str, bytes]:
    """The shot by one process that nothing disturbs."""
    folder = tmp_path_factory.mktemp("whole")
    render(trained, folder)
    found = contents(folder)
    assert len(found) == 10 * 2 * 2
    return found


def test_a_cluster_writes_the_same_bytes_as_one_process(trained, whole, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as cluster:
        render(trained, tmp_path, "--scheduler", cluster.scheduler_address)
    assert contents(tmp_path) == whole


def test_two_processes_of_which_one_is_killed_write_the_same_bytes_as_one(trained, whole, tmp_path):
    with spawned(trained, tmp_path, "--jobs", 2) as process:
        wait_for_images(tmp_path, 3, process)
        os.kill(children(process.pid)[0], signal.SIGKILL)
        _, log = process.communicate(timeout=120)
    assert process.returncode == 0, log
    assert contents(tmp_path) == whole


def test_a_run_that_is_killed_again_and_again_goes_on_to_the_same_bytes(trained, whole, tmp_path):
    chance = random.Random(7)
    for attempt in range(3):
        with spawned(trained, tmp_path, "--jobs", 1 + attempt % 2, "--skip-existing") as process:
            wait_for_images(tmp_path, 8 * attempt + chance.randint(1, 6), process)
            time.sleep(chance.random() * 0.1)
            process.kill()
            process.communicate()
        there = {str(path.relative_to(tmp_path)): path.read_bytes() for path in images(tmp_path)}
        assert there == {name: whole[name] for name in there}
    # What workers that outlive their parent for a moment have in hand.
    time.sleep(1)
    render(trained, tmp_path, "--skip-existing")
    assert contents(tmp_path) == whole


def test_sigterm_ends_a_run_with_143_and_nothing_half_done(trained, whole, tmp_path):
    with spawned(trained, tmp_path, "--jobs", 2) as process:
        wait_for_images(tmp_path, 2, process)
        process.terminate()
        process.communicate(timeout=60)
    assert process.returncode == 143
    found = contents(tmp_path)
    assert 0 < len(found) < len(whole)
    assert found == {name: whole[name] for name in found}


def test_only_what_is_missing_or_broken_or_of_another_job_is_rendered(trained, whole, tmp_path):
    shot = ("--frames", "1003-1005", *SHOT[2:])
    wanted = {name: data for name, data in whole.items() if name[-8:-4] in ("1003", "1004", "1005")}

    def rendered(*more) -> tuple[int, int]:
        flags = ("--skip-existing", "--json", tmp_path / "j")
        render(trained, tmp_path / "exr", *flags, *more, shot=shot)
        facts = json.loads((tmp_path / "j").read_text())
        return facts["images"], facts["skipped"]

    for name, data in wanted.items():
        path = tmp_path / "exr" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    assert rendered() == (0, 6)
    broken = tmp_path / "exr" / "cam0" / "avatar.cam0.1003.exr"
    broken.write_bytes(broken.read_bytes()[:-100])
    (tmp_path / "exr" / "cam0" / "avatar_deep.cam0.1005.exr").unlink()
    assert rendered() == (4, 2)
    assert contents(tmp_path / "exr") == wanted
    assert rendered("--colorspace", "ACEScg") == (6, 0)
    assert rendered("--colorspace", "ACEScg") == (0, 6)


def test_frames_asked_for_alone_are_those_of_the_whole(trained, whole, tmp_path):
    shot = ("--frames", "1002-1010x4", *SHOT[2:])
    render(trained, tmp_path, shot=shot)
    found = contents(tmp_path)
    assert len(found) == 3 * 2 * 2
    assert found == {name: whole[name] for name in found}


def test_a_farms_template_renders_the_same_bytes(trained, whole, tmp_path):
    openjd = Path(sys.executable).with_name("openjd")
    if not openjd.exists():
        pytest.skip("openjd is not installed: pip install openjd-cli")
    job = tmp_path / "job.json"
    render(trained, tmp_path / "exr", "--openjd", job, "--chunk", 5)
    assert not (tmp_path / "exr").exists()
    path = os.pathsep.join([str(openjd.parent), os.environ["PATH"]])
    subprocess.run(
        [str(openjd), "run", str(job)], check=True, capture_output=True, env=os.environ | {"PATH": path}
    )
    assert contents(tmp_path / "exr") == whole


def alphas(folder: Path, camera: str, frame: int = 1004) -> np.ndarray:
    with OpenEXR.File(str(folder / camera / f"avatar.{camera}.{frame}.exr")) as file:
        return file.channels()["RGBA"].pixels[..., 3].astype(float)


def test_cameras_from_our_usd_or_a_json_file_are_those_of_the_rig(trained, tiny_capture, tmp_path):
    rig = [CameraPath((camera,)) for camera in open_capture(tiny_capture).cameras]
    write_cameras_json(rig, tmp_path / "rig.json")
    main(["export", str(trained), "--usd", str(tmp_path / "a.usda"), "--progress", "none"])
    frames = ("--frames", "1004")
    render(trained, tmp_path / "rig", shot=frames)
    render(trained, tmp_path / "json", "--cameras", tmp_path / "rig.json", shot=frames)
    render(trained, tmp_path / "usd", "--cameras", tmp_path / "a.usda", "--camera", "cam?", shot=frames)
    assert contents(tmp_path / "json") == contents(tmp_path / "rig")
    for camera in ("cam0", "cam1", "cam2", "cam3"):
        assert np.abs(alphas(tmp_path / "usd", camera) - alphas(tmp_path / "rig", camera)).max() < 2e-3


def layout(path: Path, rate: float) -> Path:
    """A film's layout: a camera that moves a metre a second, and an orthographic one for a plan."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetTimeCodesPerSecond(rate)
    place = UsdGeom.Camera.Define(stage, "/cams/shotCam").AddTranslateOp()
    for second in (-1, 1):
        place.Set(Gf.Vec3d(second, 0.9, 3.5), 1001 + second * rate)
    UsdGeom.Camera.Define(stage, "/cams/top").CreateProjectionAttr("orthographic")
    stage.Save()
    return path


def test_a_layout_of_another_rate_is_drawn_by_seconds_and_its_other_cameras_left_alone(
    trained, tmp_path, capsys
):
    shot = ("--frames", "1001,1004", "--camera", "shot*", "--res", "96", "54")
    same, other = layout(tmp_path / "same.usda", 30.0), layout(tmp_path / "other.USDA", 24.0)
    render(trained, tmp_path / "same", "--cameras", same, shot=shot)
    render(trained, tmp_path / "other", "--cameras", other, shot=shot)
    for frame in (1001, 1004):
        found, expected = (alphas(tmp_path / name, "shotCam", frame) for name in ("other", "same"))
        assert expected.sum() > 20
        assert np.abs(found - expected).max() < 2e-3
    assert np.abs(alphas(tmp_path / "same", "shotCam", 1001) - expected).max() > 0.05
    capsys.readouterr()
    for camera in ("all", "top"):
        flags = ("--cameras", same, "--camera", camera, "--res", 96, 54, "--png", tmp_path / "png")
        said = failure(capsys, "render", trained, *flags)
        assert "same.usda, camera /cams/top: expected a perspective camera, found an orthographic one" in said
        assert "choose others with --camera" in said
    said = failure(capsys, "render", trained, *flags, "--camera", "side")
    assert "expected all, turntable, orbit, dolly, or some of shotCam, top" in said


def test_a_turntable_read_from_our_usd_is_the_one_we_render(trained, tmp_path):
    main(["export", str(trained), "--usd", str(tmp_path / "a.usda"), "--progress", "none"])
    shot = ("--frames", "1004", "--camera", "turntable", "--res", "108", "144")
    # The asset's turntable has the resolution of its cameras: the same aspect.
    render(trained, tmp_path / "made", shot=shot)
    render(trained, tmp_path / "read", "--cameras", tmp_path / "a.usda", shot=shot)
    found, made = (alphas(tmp_path / name, "turntable") for name in ("read", "made"))
    assert made.sum() > 100
    assert np.abs(found - made).max() < 5e-3


@pytest.mark.parametrize("camera", ["turntable", "orbit", "dolly"])
def test_cameras_made_for_the_motion_see_the_person(trained, tmp_path, camera):
    render(trained, tmp_path, shot=("--frames", "1004", "--camera", camera))
    alpha = alphas(tmp_path, camera)
    assert alpha.shape == (64, 48)
    assert 0.02 < alpha.mean() < 0.8


def test_an_open_shutter_blurs_what_moves(trained, tmp_path):
    shot = ("--frames", "1002", "--camera", "cam0", "--res", "192", "256")
    render(trained, tmp_path / "sharp", shot=shot)
    blur = ("--motion-samples", 4, "--shutter", -0.5, 0.5)
    render(trained, tmp_path / "blurred", *blur, shot=shot)
    specs = [
        oiio.ImageBuf(str(tmp_path / name / "cam0/avatar.cam0.1002.exr")) for name in ("sharp", "blurred")
    ]
    sharp, blurred = (spec.get_pixels(oiio.FLOAT)[..., 3] for spec in specs)
    assert specs[1].spec()["shutterAngle"] == 360.0
    assert ((blurred > 0.05) & (blurred < 0.95)).sum() > ((sharp > 0.05) & (sharp < 0.95)).sum()
    assert blurred.sum() == pytest.approx(sharp.sum(), rel=0.02)


def failure(capsys, *arguments) -> str:
    with pytest.raises(SystemExit) as stop:
        main([*map(str, arguments), "--progress", "none"])
    assert stop.value.code == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith("dsar: ")
    return message


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--camera", "cam9"), "expected all, turntable, orbit, dolly, or some of cam0, cam1, cam2, cam3"),
        (
            ("--aov", "rgba,normals"),
            "expected some of rgba, alpha, Z, N, P, motion, id, crypto, found normals",
        ),
        (("--colorspace", "rec2021"), "found 'rec2021'"),
        (("--ocio", "none.ocio"), "expected an OCIO configuration, found no such file"),
        (("--motion-samples", "4"), "the shutter is never open"),
        (("--shutter", "0.5", "-0.5"), "expected opening and closing times from -1 to 1"),
        (("--deep", "--motion-samples", "2", "--shutter", "0", "0.5"), "leave --motion-samples out"),
        (("--jobs", "0"), "--jobs 0"),
        (("--jobs", "2", "--scheduler", "tcp://localhost:1"), "exclude each other"),
        (("--overscan", "-1"), "--overscan"),
        (("--chunk", "0", "--openjd", "job.json"), "at least one frame per task"),
        (("--name", "a b"), "found 'a b'"),
        (("--name", "../a"), "found '../a'"),
        (("--name", ""), "found ''"),
        (("--res", "0", "64"), "--res 0 64: expected width and height in pixels"),
        (("--frames", "1011"), "outside motion bend"),
    ],
)
def test_wrong_flags_are_told_before_any_work(trained, tmp_path, capsys, flags, said):
    assert said in failure(capsys, "render", trained, "--exr", tmp_path / "exr", *flags)
    assert not (tmp_path / "exr").exists()


@pytest.mark.parametrize("name", ["../a", "a/b", "", ".a"])
@pytest.mark.parametrize("what", [("render", "--png"), ("export", "--ply"), ("export", "--spz")])
def test_no_name_leads_files_out_of_their_folder(trained, tmp_path, capsys, what, name):
    place = tmp_path / "deep" / "out"
    shot = (trained, what[1], place, "--frames", "1001", "--name", name)
    assert f"--name: expected a name that can be a file's, found '{name}'" in failure(capsys, what[0], *shot)
    assert not list(tmp_path.iterdir())


def test_a_multipart_file_holds_all_views(trained, tmp_path):
    shot = ("--frames", "1004", "--camera", "cam0,cam2", "--exr-views", "multipart")
    render(trained, tmp_path, shot=shot)
    (path,) = tmp_path.rglob("*.exr")
    assert path == tmp_path / "avatar.1004.exr"
    with OpenEXR.File(str(path)) as file:
        assert [part.header["view"] for part in file.parts] == ["cam0", "cam2"]
    shutil.rmtree(tmp_path)
