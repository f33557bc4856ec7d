"""Ranks that torchrun starts: the same run as our own workers, one voice, one writer, one end."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest
import torch
from safetensors.torch import load_file

from dsar.cli import main
from tests.conftest import train_arguments

STEPS = ("--steps", "40", "--schedule.template-fraction", "0.1")
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
    _, message = process.communicate(timeout=60)
    assert process.returncode not in (0, None), message
    return [line for line in message.splitlines() if line.startswith("dsar: ")]


@pytest.fixture(scope="module")
def stopped(tiny_capture, tmp_path_factory):
    """A run of two ranks that got SIGTERM in its midst, as from a cluster that wants its machines back."""
    folder = tmp_path_factory.mktemp("ranks")
    process = ranks(folder, train_arguments(tiny_capture, folder / "run", *STEPS))
    wait_for(folder / "run" / "metrics.jsonl", process)
    process.send_signal(signal.SIGTERM)
    (line,) = said(process)
    assert "terminated; training is saved up to update" in line
    step = json.loads((folder / "run" / "checkpoint" / "progress.json").read_text())["step"]
    assert 20 <= step < 40
    return folder / "run"


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch):
    monkeypatch.setattr("dsar.cli.train.write_previews", lambda folder, _: folder)


def test_two_ranks_are_two_workers_to_the_bit(tiny_capture, stopped, tmp_path):
    """What ranks began, workers end as if they had done it all."""
    shutil.copytree(stopped, tmp_path / "ranks")
    arguments = (*STEPS, "--workers", "2")
    main(train_arguments(tiny_capture, tmp_path / "workers", *arguments))
    main(train_arguments(tiny_capture, tmp_path / "ranks", *arguments, "--resume"))
    paths = sorted((tmp_path / "workers" / "checkpoint").glob("*.safetensors"))
    assert {"rollouts-0", "rollouts-1", "registration-1", "avatar"} <= {path.stem for path in paths}
    for path in paths:
        a, b = load_file(path), load_file(tmp_path / "ranks" / "checkpoint" / path.name)
        assert a.keys() == b.keys()
        for key in a:
            assert torch.equal(a[key], b[key]), f"{path.stem}: {key}"
    configs = [(tmp_path / name / "config.json").read_text() for name in ("workers", "ranks")]
    assert configs[0] == configs[1]


def test_a_run_goes_on_with_another_number_of_workers(tiny_capture, stopped, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(stopped, run)
    before = [load_file(run / "checkpoint" / f"rollouts-{rank}.safetensors") for rank in (0, 1)]
    with pytest.raises(SystemExit):
        main(train_arguments(tiny_capture, run, *STEPS, "--workers", "3", "--resume"))
    assert "4 rollouts (2 workers of 2), which 3 workers" in capsys.readouterr().err
    main(train_arguments(tiny_capture, run, *STEPS, "--workers", "1", "--resume"))
    assert json.loads((run / "checkpoint" / "progress.json").read_text())["step"] == 40
    assert not (run / "checkpoint" / "rollouts-1.safetensors").exists()
    rollouts = load_file(run / "checkpoint" / "rollouts-0.safetensors")
    assert len(rollouts["fresh"]) == sum(len(part["fresh"]) for part in before) == 4
    # The settings say how the run began, so that its command stays the same.
    assert json.loads((run / "config.json").read_text())["workers"] == 2


def test_a_rank_that_dies_ends_all_with_one_line_and_leaves_nothing_half_written(tiny_capture, tmp_path):
    process = ranks(tmp_path, train_arguments(tiny_capture, tmp_path / "run", "--steps", "100000"))
    wait_for(tmp_path / "run" / "metrics.jsonl", process)
    os.kill(int((tmp_path / "rank-1").read_text()), signal.SIGKILL)
    began = time.monotonic()
    (line,) = said(process)
    assert time.monotonic() - began < 15, "it waited for who is gone"
    assert "a rank of 2 ended before its time" in line
    assert "no checkpoint was written yet" in line or "saved up to update" in line
    left = {path.name for path in (tmp_path / "run").iterdir()}
    assert left <= {"checkpoint", "config.json", "metrics.jsonl", "scene.safetensors"}
