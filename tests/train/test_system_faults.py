"""Every command of the README where the system does not play along: one line, exit 2, nothing broken."""

import contextlib
import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
from conftest import TINY
from faults import contents, cut, full_disk, read_only
from pxr import Gf, Usd, UsdGeom

from dsar.body.files import load_body
from dsar.cli import main
from dsar.data.captures.formats import open_capture
from dsar.data.motions.files import write_motion
from dsar.evaluation.stress import run_causal

README = Path(__file__).parents[2] / "README.md"
COMMANDS = re.findall(r"^dsar ([^#\n]*[^#\n ])", README.read_text(), re.MULTILINE)
SMALL = {"--preset small": shlex.join(TINY), "--jobs 8": "--jobs 2", "--progress none": ""}
"""What makes the README's commands small enough for a test."""


@pytest.fixture(scope="module")
def made(tiny_capture, trained, tmp_path_factory):
    """The files that the README's commands speak of."""
    folder = tmp_path_factory.mktemp("made")
    shutil.copytree(tiny_capture, folder / "my_capture")
    shutil.copytree(trained, folder / "runs" / "anna")
    config = folder / "runs" / "anna" / "config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"capture": "my_capture"}, indent=2))
    write_motion(folder / "walk.npz", open_capture(tiny_capture).motions["bend"].slice(0, 3), load_body())
    stage = Usd.Stage.CreateNew(str(folder / "layout.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    stage.SetTimeCodesPerSecond(30)
    camera = UsdGeom.Camera.Define(stage, "/shot")
    camera.AddTranslateOp().Set(Gf.Vec3d(0, 0, 3))
    stage.Save()
    quiet = ("--frames", "1001", "--progress", "none")
    main(["export", str(trained), "--usd", str(folder / "anna.usda"), *quiet])
    # A full disk would not keep the kernels that a command compiles first.
    main(["check", str(tiny_capture), "--sheet", str(tmp_path_factory.mktemp("sheet") / "a.png")])
    return folder


@pytest.fixture
def place(made, tmp_path, monkeypatch):
    """A copy of them, as the current folder."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("dsar.evaluation.stress.CASES", {"causal": run_causal})
    return tmp_path


def arguments(command):
    """Return a README's command at a size for tests."""
    for large, small in SMALL.items():
        command = command.replace(large, small)
    if command.startswith("train"):
        if "--resume" not in command:
            command = command.replace("runs/anna", "runs/new")
        command += " --steps 124 --workers 1"
    elif command.startswith("render"):
        command += " --frames 1001-1002 --res 48 64"
    elif command.startswith("crosscheck"):
        command += " --variant scalar_rgb"
    elif "--ablations" in command:
        command += " --capture my_capture --steps 12"
    return [*shlex.split(command), "--progress", "none"]


def refusal(capsys, command):
    """Return the one line with which a command ends."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        main(arguments(command))
    said = capsys.readouterr().err
    assert stop.value.code == 2, said
    assert "Traceback" not in said
    (line,) = (line for line in said.splitlines() if line.startswith("dsar: "))
    assert said.endswith(f"{line}\n")
    return line


@pytest.mark.parametrize("command", COMMANDS)
def test_a_read_only_folder_is_one_line_before_any_work(command, place, capsys):
    before = contents(place)
    with read_only(place):
        if "--check" in command:
            main(arguments(command))  # it writes nothing
        else:
            assert "Permission denied: write elsewhere" in refusal(capsys, command)
    assert contents(place) == before


@pytest.mark.parametrize("command", [each for each in COMMANDS if "--check" not in each])
def test_a_full_disk_is_one_line_and_leaves_nothing_broken(command, place, capsys):
    before = contents(place)
    with full_disk(100):
        assert "File too large: free some room" in refusal(capsys, command)
    assert contents(place) == before


def on_a_run(command):
    return "runs/anna" in command and ("train" not in command or "--resume" in command)


@pytest.mark.parametrize("command", list(filter(on_a_run, COMMANDS)))
@pytest.mark.parametrize("size", [0, 1000, 20_000])
def test_a_cut_checkpoint_is_one_line_that_names_it(command, size, place, capsys):
    cut(place / "runs" / "anna" / "checkpoint" / "avatar.safetensors", size)
    before = contents(place)
    assert "avatar.safetensors" in refusal(capsys, command)
    assert contents(place) == before


def test_a_cut_asset_is_one_line_that_names_it(place, capsys):
    (command,) = (each for each in COMMANDS if "--check" in each)
    cut(place / "anna.usda", 1000)
    assert "anna.usda" in refusal(capsys, command)


def test_a_render_that_a_full_disk_stopped_goes_on_to_the_same_bytes(place, capsys):
    command = [
        *("render", "runs/anna", "--exr", "shot", "--png", "look", "--camera", "cam0,cam2"),
        *("--progress", "none"),
    ]
    main([*command, "--exr", "whole/shot", "--png", "whole/look"])
    largest = max(path.stat().st_size for path in (place / "whole").rglob("*.exr"))
    with full_disk(largest - 1), pytest.raises(SystemExit) as stop:
        main(command)
    assert stop.value.code == 2
    assert "--skip-existing" in capsys.readouterr().err
    whole = {path.relative_to(place / "whole"): bytes_ for path, bytes_ in contents(place / "whole").items()}
    there = {path.relative_to(place): path.read_bytes() for path in written(place)}
    assert there.items() < whole.items()
    main([*command, "--skip-existing"])
    assert {path.relative_to(place): path.read_bytes() for path in written(place)} == whole


def written(place):
    return [path for name in ("shot", "look") for path in (place / name).rglob("*") if path.is_file()]


def test_an_interrupt_says_what_is_kept(place, capsys, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    for module, command, kept in (
        ("dsar_exporters.export", "export runs/anna --ply a", "the frames that were finished stay"),
        ("dsar_render.render_shot", "render runs/anna --png a", "--skip-existing goes on"),
        ("dsar_render.render_shot", "render runs/anna --mp4 a.mp4", "nothing was written"),
        ("dsar.training.loop.train", "train my_capture --resume --out runs/anna", "saved up to update 120"),
        ("dsar.training.loop.train", "train my_capture --out runs/other", "no checkpoint was written yet"),
        ("dsar.data.captures.formats.open_capture", "check my_capture", "nothing was written"),
    ):
        with contextlib.ExitStack() as stack:
            patch = stack.enter_context(pytest.MonkeyPatch.context())
            patch.setattr(module, interrupt)
            with pytest.raises(SystemExit) as stop:
                main([*shlex.split(command), "--progress", "none"])
        said = capsys.readouterr().err
        assert stop.value.code == 130
        assert kept in said
        assert ("--resume" in said) == ("update 120" in said)
