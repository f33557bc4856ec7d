"""Whole runs on the tiny capture, through the command line as a user starts them."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest
import torch
from safetensors.torch import load_file

from dsar.cli import main
from dsar.training.checkpoint import Run, load_checkpoint
from tests.conftest import train_arguments


def started(arguments) -> subprocess.Popen:
    """Start `dsar` as a process of its own, warnings as errors."""
    command = [sys.executable, "-m", "dsar", *arguments]
    environment = {**os.environ, "PYTHONWARNINGS": "error"}
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def finished(process: subprocess.Popen, code: int = 0) -> None:
    """Wait for a process and check how it ended."""
    _, message = process.communicate(timeout=240)
    assert process.returncode == code, message


def test_training_leaves_everything_the_contract_names_and_gets_better(trained):
    lines = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [20, 40, 60, 80, 100, 120]
    assert lines[-1]["psnr"] > lines[0]["psnr"] + 1
    assert json.loads((trained / "config.json").read_text())["model"]["window"] == 3
    assert (trained / "previews" / "sheet.png").stat().st_size > 1000
    assert json.loads((trained.parent / "train.json").read_text())["step"] == 120


def test_an_interrupted_run_resumes_to_the_same_bits(tiny_capture, tmp_path):
    """Two workers; SIGINT once training moves, then the same command with --resume."""
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    command = ("--steps", "60", "--workers", "2", "--schedule.template-fraction", "0.1")
    finished(started(train_arguments(tiny_capture, whole, *command)))
    process = started(train_arguments(tiny_capture, stopped, *command))
    deadline = time.monotonic() + 120
    while not (stopped / "metrics.jsonl").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    finished(process, 130)
    step = json.loads((stopped / "checkpoint" / "progress.json").read_text())["step"]
    assert 20 <= step < 60
    finished(started(train_arguments(tiny_capture, stopped, *command, "--resume")))
    for name in ("avatar", "adam", "muon", "rollouts-0", "rollouts-1"):
        a, b = (load_file(folder / "checkpoint" / f"{name}.safetensors") for folder in (whole, stopped))
        assert a.keys() == b.keys()
        for key in a:
            assert torch.equal(a[key], b[key]), f"{name}: {key}"


def test_a_value_that_is_not_finite_stops_the_run_and_is_named(tiny_capture, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(
            train_arguments(
                tiny_capture, tmp_path / "run", "--steps", "40", "--workers", "1",
                "--schedule.learning-rate", "1e38", "--schedule.max-gradient-norm", "1e38",
            )
        )  # fmt: skip
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert re.search(r"step \d+.*(network|template|state)\.\w+", message), message
    assert "finite" in message


def test_a_run_is_never_overwritten_by_accident(trained, tiny_capture, capsys):
    with pytest.raises(SystemExit) as stop:
        main(train_arguments(tiny_capture, trained, "--steps", "5"))
    assert stop.value.code == 2
    assert "--resume" in capsys.readouterr().err


def test_resuming_with_other_settings_is_refused(trained, tiny_capture, capsys):
    arguments = train_arguments(tiny_capture, trained, "--steps", "120", "--workers", "1", "--resume")
    with pytest.raises(SystemExit) as stop:
        main([*arguments, "--model.window", "4"])
    assert stop.value.code == 2
    assert "model" in capsys.readouterr().err


def test_a_loaded_avatar_is_the_trained_one(trained):
    avatar, config, provenance = load_checkpoint(Run(trained))
    saved = load_file(trained / "checkpoint" / "avatar.safetensors")
    assert torch.equal(avatar.template.means, saved["template.means"])
    assert config.preset == "demo"
    assert len(provenance["checkpoint"]) == 16


def test_a_limit_on_time_changes_nothing_where_there_is_time(tiny_capture, tmp_path):
    command = ("--steps", "30", "--schedule.template-fraction", "0.2")
    free, limited = tmp_path / "free", tmp_path / "limited"
    main(train_arguments(tiny_capture, free, *command))
    main(train_arguments(tiny_capture, limited, *command, "--minutes", "30"))
    a, b = (load_file(folder / "checkpoint" / "avatar.safetensors") for folder in (free, limited))
    assert all(torch.equal(a[key], b[key]) for key in a)
    assert "Cut short" not in (limited / "report.html").read_text()


def test_a_run_that_was_too_slow_for_its_limit_says_so(tiny_capture, tmp_path, caplog):
    folder, found = tmp_path / "short", tmp_path / "short.json"
    options = ("--steps", "100000", "--minutes", "0.05", "--json", str(found))
    main(train_arguments(tiny_capture, folder, *options))
    reached = json.loads(found.read_text())
    assert 0 < reached["step"] < 10_000
    assert reached["step"] + reached["skipped"] == pytest.approx(100_000, abs=2)
    assert re.search(r"Cut short: \d+ of \d+ updates; .* 0.05 minutes", caplog.text)
    at = json.loads((folder / "checkpoint" / "progress.json").read_text())
    assert at["progress"] == 1
    assert round(at["skipped"]) == reached["skipped"]
    assert 1 < at["seconds"] < 6
    assert f"Cut short: {reached['step']} of" in (folder / "report.html").read_text()
