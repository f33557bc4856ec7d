import json
import subprocess
import sys
from pathlib import Path

import pytest

from dsar.errors import ConfigError
from dsar.geometry.frame_numbers import parse_frames
from dsar_render.openjd import openjd_template

OPENJD = Path(sys.executable).parent / "openjd"
NOTE = "import pathlib, sys; pathlib.Path(sys.argv[1], sys.argv[3]).write_text(' '.join(sys.argv[2:]))"


def _openjd(verb, template, folder, *arguments):
    path = folder / "job.template.json"
    path.write_text(template)
    command = [str(OPENJD), verb, str(path), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def _chunks(template):
    (step,) = json.loads(template)["steps"]
    (frames,) = step["parameterSpace"]["taskParameterDefinitions"]
    return frames["range"]


def test_a_job_runs_every_chunk_of_frames_and_each_with_its_own(tmp_path):
    frames = [*range(1001, 1008), 1010, 1012, 1014]
    command = [sys.executable, "-c", NOTE, str(tmp_path / "out")]
    template = openjd_template("shot 10: avatar", command, frames, chunk=4)
    (tmp_path / "out").mkdir()
    checked = _openjd("check", template, tmp_path)
    assert checked.returncode == 0, checked.stdout
    ran = _openjd("run", template, tmp_path)
    assert ran.returncode == 0, ran.stdout
    assert {path.name: path.read_text() for path in (tmp_path / "out").iterdir()} == {
        part: f"--frames {part} --progress plain" for part in ("1001-1004", "1005-1007,1010", "1012,1014")
    }


def test_a_command_that_fails_fails_the_job(tmp_path):
    template = openjd_template("avatar", [sys.executable, "-c", "raise SystemExit(2)"], [1001], chunk=1)
    ran = _openjd("run", template, tmp_path)
    assert ran.returncode != 0
    assert "exited with code: 2" in ran.stdout


def test_a_farm_may_have_the_program_elsewhere(tmp_path):
    template = openjd_template("avatar", ["/nowhere/dsar", "-c", "pass"], [1001], chunk=1)
    assert _openjd("run", template, tmp_path).returncode != 0
    ran = _openjd("run", template, tmp_path, "--job-param", f"Program={sys.executable}")
    assert ran.returncode == 0, ran.stdout


@pytest.mark.parametrize("frames", [range(1001, 1011), range(1001, 1100, 3), [1], [-4, -3, -2, 8, 9, 100]])
@pytest.mark.parametrize("chunk", [1, 3, 1000])
def test_chunks_are_frames_in_order_as_the_frames_flag_reads_them(frames, chunk):
    chunks = [
        parse_frames(text) for text in _chunks(openjd_template("a", ["dsar"], list(frames), chunk=chunk))
    ]
    assert [frame for part in chunks for frame in part] == list(frames)
    assert all(len(part) == chunk for part in chunks[:-1])


def test_canceling_sends_sigterm_first():
    (step,) = json.loads(openjd_template("a", ["dsar", "render"], [1001], chunk=1))["steps"]
    run = step["script"]["actions"]["onRun"]
    assert run["cancelation"] == {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": 120}


def test_as_many_tasks_as_the_specification_allows_pass_its_check(tmp_path):
    template = openjd_template("a", ["dsar"], range(1, 1024 * 2 + 1), chunk=2)
    assert len(_chunks(template)) == 1024
    checked = _openjd("check", template, tmp_path)
    assert checked.returncode == 0, checked.stdout


@pytest.mark.parametrize(
    ("command", "frames", "chunk", "message"),
    [
        (["dsar"], range(1, 2050), 2, r"1025 tasks, .* at most 1024: take chunks of at least 3"),
        (
            ["dsar"],
            [n * n for n in range(200, 500)],
            300,
            "frames of one task .* smaller chunks than 300",
        ),
        (["dsar"], [], 1, "found none"),
        (["dsar"], [1], 0, "at least one frame per task, found 0"),
        (["dsar", "--exr", "/a/{{b}}"], [1], 1, "cannot be written otherwise"),
    ],
    ids=["tasks", "letters", "frames", "chunk", "braces"],
)
def test_what_the_specification_does_not_allow_is_refused(command, frames, chunk, message):
    with pytest.raises(ConfigError, match=message):
        openjd_template("avatar", command, frames, chunk=chunk)
