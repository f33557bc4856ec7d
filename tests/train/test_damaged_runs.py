"""Files of a run that are cut, empty, foreign or missing: one line that names the file, and exit code 2."""

import json
import re
import shutil
from pathlib import Path

import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

import dsar
from dsar.cli import main
from dsar.config import config_from_json
from dsar.errors import CheckpointError, ConfigError
from dsar.evaluation.report import write_report
from dsar.training.checkpoint import Run, load_checkpoint, newest_run
from dsar.training.report import Monitor, UpdateMetrics
from dsar.training.scene import open_scene
from tests.conftest import train_arguments

AVATAR = "checkpoint/avatar.safetensors"


@pytest.fixture
def run(trained, tmp_path) -> Path:
    shutil.copytree(trained, tmp_path / "run")
    return tmp_path / "run"


def open_all(folder: Path) -> None:
    """Open everything that commands open of a run."""
    run = Run(folder)
    _, config, _ = load_checkpoint(run)
    open_scene(run, config)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: min(1000, path.stat().st_size // 2)])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def text(path: Path) -> None:
    path.write_text("It was a dark and stormy night.\n" * 9)


def html(path: Path) -> None:
    path.write_text("<!DOCTYPE html><html><body>404 Not Found</body></html>")


def zeros(path: Path) -> None:
    """As a full disk or a lost network mount leaves it."""
    path.write_bytes(bytes(path.stat().st_size))


def other_json(path: Path) -> None:
    path.write_text("[1, 2]")


def latin(path: Path) -> None:
    path.write_bytes('{"capture": "Übung"}'.encode("latin-1"))


def other_tensors(path: Path) -> None:
    save_file({"weight": torch.zeros(2)}, path)


@pytest.mark.parametrize("name", [AVATAR, "config.json", "checkpoint/progress.json", "scene.safetensors"])
@pytest.mark.parametrize("damage", [cut, empty, text, html, zeros, other_json, latin, other_tensors])
def test_a_damaged_file_of_a_run_is_named_in_one_line(run, name, damage):
    damage(run / name)
    with pytest.raises(CheckpointError) as caught:
        open_all(run)
    assert str(caught.value).startswith(f"{run / name}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [AVATAR, "config.json"])
def test_a_missing_file_of_a_run_is_named(run, name):
    (run / name).unlink()
    with pytest.raises(CheckpointError, match=r"found no such file") as caught:
        open_all(run)
    assert str(caught.value).startswith(f"{run / name}: ")


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (("export", "{run}", "--ply", "{out}"), AVATAR),
        (("render", "{run}", "--png", "{out}"), "config.json"),
        (("eval", "{run}"), "checkpoint/progress.json"),
        (("stress", "{run}"), "scene.safetensors"),
        (("crosscheck", "{run}"), AVATAR),
    ],
)
def test_every_command_says_so_and_exits_with_2(run, tmp_path, capsys, arguments, name):
    cut(run / name)
    with pytest.raises(SystemExit) as stop:
        main([each.format(run=run, out=tmp_path / "out") for each in arguments])
    assert stop.value.code == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith(f"dsar: {run / name}: ")
    assert not (tmp_path / "out").exists()
    cut(run / AVATAR)
    with pytest.raises(CheckpointError):
        dsar.load(run)


def edited(run: Path, change) -> None:
    tensors = load_file(run / AVATAR)
    change(tensors)
    save_file(tensors, run / AVATAR)


def test_values_that_are_not_finite_are_counted_by_name(run):
    name = "template.means"
    edited(run, lambda tensors: tensors[name].view(-1)[:12].fill_(float("nan")))
    with pytest.raises(CheckpointError, match=f"{name} has 12 values that are not finite: training"):
        dsar.load(run)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.pop("body_joints"), "lacks 'body_joints'"),
        (lambda t: t.pop("template.means"), r"template\.means has shape none, by config\.json \(\d+, 3\)"),
        (lambda t: t.update(more=torch.zeros(2)), r"more has shape \(2,\), by config\.json none"),
        (lambda t: t.update({"template.means": torch.zeros(5, 3)}), r"template\.means has shape \(5, 3\)"),
        (lambda t: t.update(texels=torch.zeros(3)), r"damaged or something else"),
    ],
)
def test_tensors_that_are_missing_or_of_other_shapes_are_named(run, change, said):
    edited(run, change)
    with pytest.raises(CheckpointError, match=said) as caught:
        dsar.load(run)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c.update(foo=1), "unknown: foo"),
        (lambda c: c["model"].update(depth=3), r"unknown: model\.depth"),
        (lambda c: c["model"].pop("heads"), r"missing: model\.heads"),
        (lambda c: c["model"].update(channels=5), r"model\.channels is 5"),
        (
            lambda c: c["model"].update(axes="camera"),
            "axes is 'camera', expected 'body' or 'surface'",
        ),
        (
            lambda c: c["schedule"].update(minutes="ten"),
            r"minutes is 'ten', expected float \| None",
        ),
        (lambda c: c.update(seed=True), "seed is True, expected int"),
        (lambda c: c.update(atlas=[]), "expected atlas as an object"),
        (lambda c: c.update(preset="huge"), "preset is 'huge'"),
        (lambda c: c["model"].update(heads=0), r"model\.heads is 0"),
    ],
)
def test_settings_that_are_unknown_missing_or_of_another_kind_are_named(run, change, said):
    config = json.loads((run / "config.json").read_text())
    change(config)
    (run / "config.json").write_text(json.dumps(config))
    with pytest.raises(ConfigError, match=said):
        config_from_json(run / "config.json")
    with pytest.raises(CheckpointError, match=said):
        dsar.load(run)


@pytest.mark.parametrize(
    "name", ["adam.safetensors", "rollouts-0.safetensors", "muon.safetensors", "registration-0.safetensors"]
)
def test_resuming_names_the_damaged_state_before_any_work(run, tiny_capture, capsys, name):
    path = run / "checkpoint" / name
    cut(path)
    before = (run / "config.json").read_bytes()
    with pytest.raises(SystemExit) as stop:
        main(train_arguments(tiny_capture, run, "--steps", "122", "--workers", "1", "--resume"))
    assert stop.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"dsar: {path}: ")
    assert (run / "config.json").read_bytes() == before


def test_a_training_curve_that_was_cut_is_shown_without_its_half_line_and_goes_on_by_a_new_one(run, caplog):
    curve = run / "metrics.jsonl"
    curve.write_bytes(curve.read_bytes()[:-20])
    write_report(Run(run))
    assert "lines that are not whole, left out: 1 of 6" in caplog.text
    monitor = Monitor(curve, 200, None)
    monitor.update(UpdateMetrics(1.0, 0.5, None))
    monitor.write(140, 0.7, "autoregressive", 1.0)
    caplog.clear()
    write_report(Run(run))
    assert "left out: 1 of 7" in caplog.text
    assert json.loads(curve.read_text().splitlines()[-1])["step"] == 140


def test_figures_that_were_cut_are_named_by_the_report(run):
    (run / "figures.json").write_text('{"splits": {"te')
    with pytest.raises(CheckpointError, match=r"figures\.json"):
        write_report(Run(run))


def test_the_newest_run_is_one_with_a_checkpoint(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match=rf"no trained run under {tmp_path / 'runs'}"):
        newest_run()
    (tmp_path / "runs" / "broken").mkdir(parents=True)
    (tmp_path / "runs" / "broken" / "config.json").write_text("{}")
    (tmp_path / "runs" / "stopped" / "checkpoint").mkdir(parents=True)
    (tmp_path / "runs" / "notes.txt").write_text("")
    with pytest.raises(CheckpointError, match="no trained run"):
        newest_run()
    shutil.copytree(run, tmp_path / "runs" / "good")
    assert newest_run().folder == Path("runs/good")


def test_what_is_no_run_is_said_to_be_what_it_is(run, tmp_path):
    (tmp_path / "a.txt").write_text("")
    for folder, said in (
        (tmp_path / "none", "no such folder"),
        (tmp_path / "a.txt", "a file, no run folder"),
    ):
        with pytest.raises(CheckpointError, match=said):
            dsar.load(folder)
    progress = (run / "checkpoint" / "progress.json").rename(tmp_path / "progress.json")
    with pytest.raises(CheckpointError, match=r"holds no checkpoint; expected .*progress\.json"):
        dsar.load(run)
    shutil.move(progress, run / "checkpoint")
    shutil.move(run / "checkpoint", run / "checkpoint.old")
    with pytest.raises(CheckpointError, match=r"checkpoint\.old of a crash: rename it"):
        dsar.load(run)


@pytest.mark.parametrize("damage", ["html", "cut", "small"])
def test_check_train_and_eval_give_the_same_reason_for_the_same_images(
    run, tiny_capture, tmp_path, capsys, damage
):
    capture = tmp_path / "capture"
    shutil.copytree(tiny_capture, capture)
    settings = json.loads((run / "config.json").read_text()) | {"capture": str(capture)}
    (run / "config.json").write_text(json.dumps(settings))
    for path in capture.glob("images/*/*/*.png"):
        if damage == "html":
            path.write_text("<html>404</html>")
        elif damage == "cut":
            path.write_bytes(path.read_bytes()[:-200])
        else:
            Image.open(path).resize((24, 32)).save(path)
    said = []
    for arguments in (
        ["check", str(capture), "--sheet", str(tmp_path / "s.png"), "--progress", "none"],
        train_arguments(capture, tmp_path / "new", "--steps", "2", "--workers", "1"),
        ["eval", str(run), "--progress", "none"],
    ):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2
        said += re.findall(r"image \S+? in \S+?: (.*)", capsys.readouterr().err)[-1:]
    assert len(said) == 3
    # They may meet an image of another camera first.
    assert len({re.sub(r"cam\d", "", line) for line in said}) == 1, said
