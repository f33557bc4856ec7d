"""Whole runs on the tiny capture, through the command line as a user starts them."""

import json
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from dsar.cli import main
from dsar.evaluation.report import write_report
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


TWO_WORKERS = ("--steps", "60", "--schedule.template-fraction", "0.1", "--workers", "2")


@pytest.fixture
def no_pictures(monkeypatch):
    monkeypatch.setattr("dsar.cli.train.write_previews", lambda folder, _: folder)


@pytest.fixture(scope="module")
def whole(tiny_capture, tmp_path_factory) -> Path:
    """A run of two workers that nothing stopped; warnings of the other one are errors, too."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONWARNINGS", "error")
        patch.setattr("dsar.cli.train.write_previews", lambda folder, _: folder)
        main(train_arguments(tiny_capture, folder, *TWO_WORKERS))
    return folder


def assert_same_bits(run: Path, other: Path) -> None:
    for name in ("avatar", "adam", "muon", "rollouts-0", "rollouts-1", "registration-0", "registration-1"):
        a, b = (load_file(folder / "checkpoint" / f"{name}.safetensors") for folder in (run, other))
        assert a.keys() == b.keys()
        for key in a:
            assert torch.equal(a[key], b[key]), f"{name}: {key}"


def test_an_interrupted_run_resumes_to_the_same_bits(tiny_capture, whole, tmp_path):
    """Two workers; SIGINT once training moves, then the same command with --resume."""
    stopped = tmp_path / "stopped"
    process = started(train_arguments(tiny_capture, stopped, *TWO_WORKERS))
    deadline = time.monotonic() + 120
    while not (stopped / "metrics.jsonl").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    finished(process, 130)
    step = json.loads((stopped / "checkpoint" / "progress.json").read_text())["step"]
    assert 20 <= step < 60
    finished(started(train_arguments(tiny_capture, stopped, *TWO_WORKERS, "--resume")))
    assert_same_bits(whole, stopped)


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


@pytest.mark.usefixtures("no_pictures")
def test_a_limit_on_time_changes_nothing_where_there_is_time(tiny_capture, whole, tmp_path):
    limited = tmp_path / "limited"
    main(train_arguments(tiny_capture, limited, *TWO_WORKERS, "--minutes", "30"))
    assert_same_bits(whole, limited)
    write_report(Run(limited))
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


PROGRAM = """
import os, pathlib, sys
pathlib.Path(sys.argv.pop(1), f"rank-{os.environ['RANK']}").write_text(str(os.getpid()))
from dsar.cli import main
main()
"""


def ranks(folder, arguments) -> subprocess.Popen:
    """Start two ranks; each leaves its process's number in the folder."""
    program = folder / "program.py"
    program.write_text(PROGRAM)
    launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
    command = [sys.executable, *launcher, str(program), str(folder), *arguments]
    environment = {**os.environ, "GLOO_SOCKET_IFNAME": "lo", "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def wait_for(path, process: subprocess.Popen) -> None:
    """Wait until a file is there, or the process has ended."""
    deadline = time.monotonic() + 120
    while not path.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)


def said(process: subprocess.Popen) -> list[str]:
    """Wait for the end of ranks that fail; return what `dsar` says, without what torchrun adds."""
    _, message = process.communicate(timeout=240)
    assert process.returncode not in (0, None), message
    return [line for line in message.splitlines() if line.startswith("dsar: ")]


@pytest.fixture(scope="module")
def stopped(tiny_capture, tmp_path_factory):
    """A run of two ranks that got SIGTERM in its midst, as from a cluster that wants its machines back."""
    folder = tmp_path_factory.mktemp("ranks")
    process = ranks(folder, train_arguments(tiny_capture, folder / "run", *TWO_WORKERS))
    wait_for(folder / "run" / "metrics.jsonl", process)
    process.send_signal(signal.SIGTERM)
    (line,) = said(process)
    assert "terminated; training is saved up to update" in line
    step = json.loads((folder / "run" / "checkpoint" / "progress.json").read_text())["step"]
    assert 20 <= step < 60
    return folder / "run"


@pytest.mark.usefixtures("no_pictures")
def test_two_workers_that_share_a_batch_are_one_within_rounding(tiny_capture, tmp_path):
    runs = []
    for workers in (1, 2):
        share = ("rollouts-per-worker", 4 // workers), ("template-frames-per-worker", 8 // workers)
        flags = [text for name, value in share for text in (f"--schedule.{name}", str(value))]
        options = ("--steps", "12", "--schedule.template-fraction", "0.25", "--workers", str(workers))
        main(train_arguments(tiny_capture, tmp_path / str(workers), *options, *flags))
        runs.append(load_file(tmp_path / str(workers) / "checkpoint" / "avatar.safetensors"))
    one, two = runs
    # A softmax does not see what is added to all of its scores: these have no gradient but rounding.
    names = [name for name in one if not name.endswith("attention.key.bias")]
    assert len(names) == len(one) - 2
    apart = {name: float((one[name].double() - two[name].double()).norm()) for name in names}
    size = {name: float(one[name].double().norm()) for name in names}
    assert [name for name in names if apart[name] > 1e-3 * size[name]] == []
    assert statistics.median(apart[name] / max(size[name], 1e-12) for name in names) < 1e-5


@pytest.mark.usefixtures("no_pictures")
def test_two_ranks_are_two_workers_to_the_bit(tiny_capture, whole, stopped, tmp_path):
    """What ranks began, workers end as if they had done it all."""
    run = tmp_path / "run"
    shutil.copytree(stopped, run)
    main(train_arguments(tiny_capture, run, *TWO_WORKERS, "--resume"))
    assert_same_bits(whole, run)
    assert (whole / "config.json").read_text() == (run / "config.json").read_text()


@pytest.mark.usefixtures("no_pictures")
def test_a_run_goes_on_with_another_number_of_workers(tiny_capture, stopped, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(stopped, run)
    before = [load_file(run / "checkpoint" / f"rollouts-{rank}.safetensors") for rank in (0, 1)]
    with pytest.raises(SystemExit):
        main(train_arguments(tiny_capture, run, *TWO_WORKERS[:-1], "3", "--resume"))
    assert "4 rollouts (2 workers of 2), which 3 workers" in capsys.readouterr().err
    main(train_arguments(tiny_capture, run, *TWO_WORKERS[:-1], "1", "--resume"))
    assert json.loads((run / "checkpoint" / "progress.json").read_text())["step"] == 60
    assert not (run / "checkpoint" / "rollouts-1.safetensors").exists()
    rollouts = load_file(run / "checkpoint" / "rollouts-0.safetensors")
    assert len(rollouts["fresh"]) == sum(len(part["fresh"]) for part in before) == 4
    # The settings say how the run began, so that its command stays the same.
    assert json.loads((run / "config.json").read_text())["workers"] == 2


def test_a_rank_that_dies_ends_all_with_one_line_and_leaves_nothing_half_written(tiny_capture, tmp_path):
    process = ranks(tmp_path, train_arguments(tiny_capture, tmp_path / "run", "--steps", "100000"))
    wait_for(tmp_path / "run" / "metrics.jsonl", process)
    os.kill(int((tmp_path / "rank-1").read_text()), signal.SIGKILL)
    (line,) = said(process)
    assert "a rank of 2 ended before its time" in line
    assert "no checkpoint was written yet" in line or "saved up to update" in line
    left = {path.name for path in (tmp_path / "run").iterdir()}
    assert left <= {"checkpoint", "config.json", "metrics.jsonl", "scene.safetensors"}
