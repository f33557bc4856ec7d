"""A run stands on its own: moved, without its capture, from any folder, on a farm: the same bytes."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from dsar.body.files import load_body
from dsar.cli import main
from dsar.data.captures.formats import open_capture
from dsar.data.motions.files import write_motion
from dsar.evaluation.stress import run_causal
from dsar.geometry.camera_files import write_cameras_json
from dsar.geometry.camera_paths import CameraPath
from dsar.training.scene import read_scene, scene_of_capture
from tests.conftest import train_arguments

OPENJD = Path(sys.executable).with_name("openjd")
SHOW = """ocio_profile_version: 1
roles: {default: raw, scene_linear: ACEScg, texture_paint: sRGB - Texture}
displays: {d: [!<View> {name: v, colorspace: raw}]}
colorspaces:
  - !<ColorSpace> {name: raw, isdata: true}
  - !<ColorSpace> {name: ACEScg}
  - !<ColorSpace> {name: sRGB - Texture, to_reference: !<ExponentTransform> {value: [1.8, 1.8, 1.8, 1]}}
"""


def command(*arguments):
    main([*map(str, arguments), "--progress", "none"])


def failure(capsys, *arguments) -> str:
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        command(*arguments)
    assert stop.value.code == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith("dsar: ")
    return message


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def deliver(run, folder: Path) -> dict[str, bytes]:
    """Return the files of all formats: of the held-out motion, a training one, and one named."""
    command("export", run, "--usd", folder / "a.usda", "--ply", folder / "ply", "--frames", "1001-1003")
    shot = ("--frames", "1002", "--camera", "cam0,turntable")
    command("render", run, "--exr", folder / "exr", "--png", folder / "png", *shot)
    command("render", run, "--exr", folder / "train", "--motion", "train", *shot)
    command("export", run, "--ply", folder / "sway", "--motion", "sway", "--frames", "1004")
    return contents(folder)


def run_job(job: Path, where: Path) -> subprocess.CompletedProcess:
    """Run a farm's job with openjd in an empty folder, with nothing of the artist's environment."""
    where.mkdir()
    paths = {"PATH": f"{OPENJD.parent}:/usr/bin:/bin", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    return subprocess.run(
        [str(OPENJD), "run", str(job)],
        cwd=where,
        env=paths | {"HOME": str(where)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_bytes_do_not_depend_on_the_number_of_threads(trained, tmp_path):
    threads = torch.get_num_threads()
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            command("export", trained, "--ply", tmp_path / str(count), "--frames", "1001-1003")
    finally:
        torch.set_num_threads(threads)
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


def test_a_run_that_moved_and_whose_capture_is_deleted_delivers_the_same_bytes(
    tiny_capture, tmp_path, monkeypatch, capsys
):
    home = tmp_path / "home"
    shutil.copytree(tiny_capture, home / "caps" / "tiny")
    monkeypatch.chdir(home)
    command(*train_arguments(Path("caps/tiny"), Path("runs/anna"), "--steps", "20", "--workers", "1"))
    assert json.loads((home / "runs/anna/config.json").read_text())["capture"] == str(home / "caps" / "tiny")
    before = deliver("runs/anna", tmp_path / "before")
    frames = ("--frames", "1001-1002", "--camera", "cam1")
    command("render", "runs/anna", "--exr", tmp_path / "whole", *frames)

    shutil.move(home / "runs" / "anna", tmp_path / "archive" / "renamed")
    shutil.rmtree(home)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    run = tmp_path / "archive" / "renamed"
    assert deliver("../archive/renamed", tmp_path / "after") == before
    monkeypatch.chdir(run)
    assert deliver(".", tmp_path / "inside") == before
    monkeypatch.setattr("dsar.evaluation.stress.CASES", {"causal": run_causal})
    command("stress", run)
    said = failure(capsys, "eval", run)
    assert f"its capture {home / 'caps' / 'tiny'} is not there" in said
    if not OPENJD.exists():
        pytest.skip("openjd is not installed: pip install openjd-cli")
    monkeypatch.chdir(tmp_path / "archive")
    command("render", "renamed", "--exr", "../farm", *frames, "--openjd", "../job.json")
    done = run_job(tmp_path / "job.json", tmp_path / "session")
    assert done.returncode == 0, done.stdout
    assert contents(tmp_path / "farm") == contents(tmp_path / "whole")


def change(path: Path, **changed) -> None:
    """Change values of a JSON file; None removes one."""
    record = json.loads(path.read_text()) | changed
    path.write_text(
        json.dumps({key: value for key, value in record.items() if changed.get(key, 0) is not None})
    )


@pytest.fixture
def older(trained, tiny_capture, tmp_path) -> Path:
    """A run as earlier versions left it, with its capture beside it: relative paths, and nothing kept."""
    run = tmp_path / "work" / "runs" / "old"
    shutil.copytree(trained, run)
    shutil.copytree(tiny_capture, tmp_path / "work" / "caps" / "tiny")
    (run / "scene.safetensors").unlink()
    change(run / "config.json", capture="caps/tiny")
    change(run / "checkpoint" / "progress.json", folder=None)
    return run


def test_an_older_run_finds_its_relative_capture_from_any_folder(older, tmp_path, monkeypatch):
    shot = ("--frames", "1002", "--ply")
    monkeypatch.chdir(older.parents[1])
    command("export", "runs/old", *shot, tmp_path / "a")
    monkeypatch.chdir(tmp_path)
    command("export", older, *shot, tmp_path / "b")
    shutil.move(older.parents[1], tmp_path / "moved")
    command("export", tmp_path / "moved" / "runs" / "old", *shot, tmp_path / "c")
    assert contents(tmp_path / "a") == contents(tmp_path / "b") == contents(tmp_path / "c") != {}


def test_an_older_run_of_the_embedded_capture_needs_nothing_on_a_farm(older, tmp_path, caplog):
    job = ("render", older, "--exr", tmp_path / "exr", "--frames", "1001", "--openjd", tmp_path / "job.json")
    command(*job)
    assert "the farm's machines need its capture" in caplog.text
    change(older / "config.json", capture="embedded")
    caplog.clear()
    command(*job)
    assert "need its capture" not in caplog.text


def test_an_older_run_without_its_capture_needs_it_for_nothing_that_is_given(older, tmp_path, capsys, caplog):
    capture = open_capture(older.parents[1] / "caps" / "tiny")
    write_motion(tmp_path / "m.npz", capture.motions["bend"], load_body())
    write_cameras_json([CameraPath((camera,)) for camera in capture.cameras], tmp_path / "rig.json")
    shot = ("--frames", "1002", "--motion", tmp_path / "m.npz")
    command("render", older, "--png", tmp_path / "a", *shot)
    command("render", older, "--png", tmp_path / "made", *shot, "--camera", "turntable", "--res", "48", "64")
    shutil.rmtree(older.parents[1] / "caps")
    command("render", older, "--png", tmp_path / "b", *shot, "--cameras", tmp_path / "rig.json")
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    command("render", older, "--png", tmp_path / "none", *shot, "--camera", "turntable", "--res", "48", "64")
    assert contents(tmp_path / "made") == contents(tmp_path / "none")
    command("export", older, "--ply", tmp_path / "ply", *shot)
    assert "not compared with training's" in caplog.text
    caplog.clear()
    command("export", older, "--usd", tmp_path / "a.usda", *shot)
    assert "of all cameras it has the turntable alone" in caplog.text
    for arguments in (
        ("export", older, "--ply", tmp_path / "x"),
        ("render", older, "--png", tmp_path / "x", *shot),
        ("render", older, "--png", tmp_path / "x", *shot, "--camera", "turntable"),
        ("stress", older),
    ):
        said = failure(capsys, *arguments)
        assert "caps/tiny is not there" in said
        assert "--motion FILE" in said
        assert "--cameras FILE" in said
    assert not (tmp_path / "x").exists()


def test_capture_and_run_that_were_moved_together_find_each_other(tiny_capture, trained, tmp_path, caplog):
    work = tmp_path / "work"
    shutil.copytree(tiny_capture, work / "caps" / "tiny")
    shutil.copytree(trained, work / "runs" / "anna")
    change(work / "runs/anna/config.json", capture=str(work / "caps" / "tiny"))
    change(work / "runs/anna/checkpoint/progress.json", folder=str(work / "runs" / "anna"))
    shutil.move(work, tmp_path / "archive")
    command("eval", tmp_path / "archive" / "runs" / "anna", "--json", tmp_path / "found.json")
    assert f"but at {tmp_path / 'archive' / 'caps' / 'tiny'}" in caplog.text
    assert json.loads((tmp_path / "found.json").read_text())["splits"]["test"]["psnr"] > 8


def test_training_goes_on_from_another_folder_and_with_the_capture_at_another_place(
    tiny_capture, trained, tmp_path, monkeypatch, capsys
):
    work = tmp_path / "work"
    shutil.copytree(tiny_capture, work / "caps" / "tiny")
    shutil.copytree(trained, work / "run")
    config, progress = work / "run" / "config.json", work / "run" / "checkpoint" / "progress.json"
    change(config, capture=str(work / "caps" / "tiny"))
    change(progress, progress=0.98)
    more = ("--workers", "1", "--resume", "--steps")
    monkeypatch.chdir(work / "caps")
    command(*train_arguments(Path("tiny"), Path("../run"), *more, "122"))
    change(progress, progress=0.98)
    shutil.move(work / "caps", tmp_path / "moved")
    monkeypatch.chdir(tmp_path)
    command(*train_arguments(Path("moved/tiny"), Path("work/run"), *more, "124"))
    assert json.loads(config.read_text())["capture"] == str(tmp_path / "moved" / "tiny")
    assert json.loads(progress.read_text())["step"] == 124
    shutil.copytree(tmp_path / "moved" / "tiny", tmp_path / "other")
    record = tmp_path / "other" / "capture.json"
    record.write_text(record.read_text().replace("70.0", "71.0"))
    said = failure(capsys, *train_arguments(Path("other"), Path("work/run"), *more, "126"))
    assert "other values of capture" in said


def test_a_run_keeps_cameras_and_motions_to_the_last_bit(trained, tiny_capture):
    capture = scene_of_capture(open_capture(tiny_capture))
    kept = read_scene(trained / "scene.safetensors")
    assert kept.is_of(capture)
    assert list(kept.motions) == ["sway", "turn", "bend"]
    assert [camera.name for camera in kept.cameras] == ["cam0", "cam1", "cam2", "cam3"]
    assert kept.splits == {"train": ("sway", "turn"), "test": ("bend",), "fd": ("bend",)}
    assert (trained / "scene.safetensors").stat().st_size < 100_000


@pytest.mark.skipif(not OPENJD.exists(), reason="openjd is not installed: pip install openjd-cli")
def test_a_farm_without_the_artists_ocio_makes_the_same_pictures_or_refuses(
    trained, tmp_path, monkeypatch, capsys
):
    (tmp_path / "show.ocio").write_text(SHOW)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OCIO", "show.ocio")
    shot = ("--frames", "1002", "--camera", "cam0", "--colorspace", "ACEScg")
    command("render", trained, "--exr", "direct", *shot)
    command("render", trained, "--exr", "farm", *shot, "--openjd", "job.json")
    monkeypatch.setenv("OCIO", str(tmp_path / "none.ocio"))
    done = run_job(tmp_path / "job.json", tmp_path / "session")
    assert done.returncode == 0, done.stdout
    assert contents(tmp_path / "farm") == contents(tmp_path / "direct")
    monkeypatch.delenv("OCIO")
    command("render", trained, "--exr", "built-in", *shot)
    assert contents(tmp_path / "built-in").keys() == contents(tmp_path / "direct").keys()
    assert contents(tmp_path / "built-in") != contents(tmp_path / "direct")
    (tmp_path / "show.ocio").write_text(SHOW.replace("1.8", "1.9"))
    said = failure(capsys, *job_arguments(tmp_path / "job.json"), "--frames", "1002")
    assert "not the same here as where the job was written: the OCIO configuration" in said


def job_arguments(path: Path) -> list[str]:
    """Return what a job's template gives dsar, but for the frames."""
    (step,) = json.loads(path.read_text())["steps"]
    arguments = step["script"]["actions"]["onRun"]["args"]
    return arguments[: arguments.index("--frames")]


def spoil_avatar(run: Path, work: Path) -> None:
    from safetensors.torch import load_file, save_file

    path = run / "checkpoint" / "avatar.safetensors"
    tensors = load_file(path)
    tensors["template.means"] += 1e-3
    save_file(tensors, path)


def spoil_settings(run: Path, work: Path) -> None:
    path = run / "config.json"
    path.write_text(path.read_text().replace('"offset_limit": 0.5', '"offset_limit": 0.4'))


def spoil_motion(run: Path, work: Path) -> None:
    write_motion(work / "m.npz", read_scene(run / "scene.safetensors").motions["sway"], load_body())


def spoil_cameras(run: Path, work: Path) -> None:
    (work / "rig.json").write_text((work / "rig.json").read_text().replace("70.0", "71.0"))


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (spoil_avatar, "the run's avatar"),
        (spoil_settings, "the run's settings"),
        (spoil_motion, "the motion"),
        (spoil_cameras, "the cameras"),
    ],
)
def test_a_job_refuses_inputs_that_changed_since_and_names_which(trained, tmp_path, capsys, spoil, named):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    scene = read_scene(run / "scene.safetensors")
    write_motion(tmp_path / "m.npz", scene.motions["bend"], load_body())
    write_cameras_json([CameraPath((camera,)) for camera in scene.cameras], tmp_path / "rig.json")
    inputs = ("--motion", tmp_path / "m.npz", "--cameras", tmp_path / "rig.json")
    command("render", run, "--exr", tmp_path / "exr", *inputs, "--openjd", tmp_path / "job.json")
    arguments = job_arguments(tmp_path / "job.json")
    command(*arguments, "--frames", "1002")
    made = contents(tmp_path / "exr")
    spoil(run, tmp_path)
    said = failure(capsys, *arguments, "--frames", "1003")
    assert f"where the job was written: {named}" in said
    assert contents(tmp_path / "exr") == made
    assert "expected NAME=HASH of dsar, checkpoint" in failure(
        capsys, "render", run, "--exr", tmp_path / "exr", "--expect", "motions=1"
    )
