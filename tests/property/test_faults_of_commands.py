"""Faults drawn for every command: it succeeds, or ends with one line and leaves nothing broken."""

import contextlib
import json
import logging
import random
import shlex
import shutil

import pytest
from conftest import TINY
from faults import contents, cut, full_disk, read_only
from skeletons import MIXAMO, write_layout

import dsar
from dsar.body.files import load_body
from dsar.cli import main
from dsar.data.captures.formats import open_capture
from dsar.data.motions.files import write_motion
from dsar.evaluation.stress import run_causal

LOGGER = logging.getLogger(__name__)
FRAMES = "--frames 1001-1002"
TRAIN = f"--workers 1 {shlex.join(TINY)}"
STORED = ("config.json", "scene.safetensors", "checkpoint/avatar.safetensors", "checkpoint/progress.json")
RUN = tuple(f"run/{name}" for name in STORED)
CAPTURE = ("capture/capture.json", "capture/motion/sway.npz", "capture/images/sway/cam1/0003.png")
STATE = (*RUN, "run/checkpoint/adam.safetensors", "run/checkpoint/rollouts-0.json", "run/metrics.jsonl")
COMMANDS = {
    "train": (f"train capture --out out/run --steps 3 {TRAIN}", CAPTURE, ("out/run",), 2),
    "resume": (f"train capture --out run --resume --steps 123 {TRAIN}", STATE, ("run",), 3),
    "check": ("check capture --sheet out/sheet.png", CAPTURE, ("out/sheet.png",), 4),
    "stage": (
        f"export run --motion walk.npz --usd out/a.usda --clips {FRAMES}",
        (*RUN, "walk.npz"),
        ("out/a.usda", "out/a.clips"),
        6,
    ),
    "splats": (
        f"export run --ply out/ply --spz out/spz --compressed-ply out/small --glb out/a.glb {FRAMES}",
        RUN,
        ("out/ply", "out/spz", "out/small", "out/a.glb"),
        6,
    ),
    "exr": (
        f"render run --motion walk.bvh --exr out/exr --camera cam0 {FRAMES}",
        (*RUN, "walk.bvh"),
        ("out/exr", "out/exr/cam0"),
        6,
    ),
    "pictures": (
        f"render run --cameras rig.json --png out/png --mp4 out/a.mp4 {FRAMES}",
        (*RUN, "rig.json"),
        ("out/png", "out/a.mp4"),
        6,
    ),
    "job": (f"render run --exr out/exr --openjd out/job.json {FRAMES}", RUN, ("out/job.json",), 5),
    "eval": ("eval run --json out/eval.json", (*RUN, *CAPTURE), ("out/eval.json",), 2),
    "stress": ("stress run --json out/stress.json", STATE, ("out/stress.json",), 4),
    "look": ("export --check in/avatar.1001.ply --json out/j", ("in/avatar.1001.ply",), ("out/j",), 5),
    "look at a stage": ("export --check in/a.usda", ("in/a.usda", "in/a.payload.usdc"), (), 4),
}
"""By name: the command, what it reads, where it writes, and how many faults are drawn."""
TIMED = ("train", "resume", "eval", "stress")
"""What they write holds times, and is not the same twice."""


@pytest.fixture(scope="module")
def made(tiny_capture, trained, tmp_path_factory):
    """What the commands read."""
    folder = tmp_path_factory.mktemp("inputs")
    shutil.copytree(tiny_capture, folder / "capture")
    shutil.copytree(trained, folder / "run")
    motion = open_capture(tiny_capture).motions["bend"].slice(0, 4)
    write_motion(folder / "walk.npz", motion, load_body())
    write_layout(folder / "walk.bvh", MIXAMO, load_body(), motion)
    shutil.copy(folder / "capture" / "capture.json", folder / "rig.json")
    with contextlib.chdir(folder):
        main(shlex.split(f"export run --usd in/a.usda --ply in {FRAMES} --progress none"))
    return folder


def run(command, capsys):
    """Return a command's exit code; check that it says one line where it fails."""
    capsys.readouterr()
    code = 0
    try:
        main([*shlex.split(command), "--progress", "none"])
    except SystemExit as stop:
        code = stop.code
    said, told = capsys.readouterr().err, capsys.readouterr().out
    lines = [line for line in said.splitlines() if line.startswith("dsar: ")]
    assert "Traceback" not in said
    assert len(lines) <= 1, said
    assert code in (0, 2), said
    assert lines or code == 0 or "check" in command, told
    return code


def foreign(rng, path):
    """Put something else in a file's place."""
    heads = (b"", b"<html>not found</html>", b"[]", b"{}", b"\x93NUMPY\x01\x00", b"\x89PNG\r\n")
    kinds = (*heads, bytes(500), rng.randbytes(3000))
    path.write_bytes(rng.choice(kinds))


def draw_fault(rng, place, inputs, outputs):
    """Return what is wrong, and a context in which it is."""
    kinds = ["full disk", "read only", "cut", "foreign", "gone", "folder"] + ["occupied"] * bool(outputs)
    kind = rng.choice(kinds)
    if kind == "full disk":
        room = round(10 ** rng.uniform(1, 5))
        return f"{kind} of {room} bytes", full_disk(room)
    if kind == "read only":
        return kind, read_only(place)
    if kind == "occupied":
        path = place / rng.choice(outputs)
        shutil.rmtree(path, ignore_errors=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir() if path.suffix else path.write_text("in the way")
        return f"{kind} {path.name}", contextlib.nullcontext()
    path = place / rng.choice(inputs)
    if kind == "cut":
        cut(path, int(path.stat().st_size * rng.random()))
    elif kind == "foreign":
        foreign(rng, path)
    else:
        path.unlink()
        if kind == "folder":
            path.mkdir()
    return f"{kind} {path.name}", contextlib.nullcontext()


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_succeeds_or_ends_in_one_line_and_leaves_nothing_broken(
    name, made, tmp_path, monkeypatch, capsys
):
    command, inputs, outputs, tries = COMMANDS[name]
    monkeypatch.setattr("dsar.evaluation.stress.CASES", {"causal": run_causal})
    whole = {}
    rng = random.Random(name)
    for attempt in range(tries + 1):
        place = tmp_path / str(attempt)
        shutil.copytree(made, place)
        settings = place / "run" / "config.json"
        recorded = json.loads(settings.read_text()) | {"capture": str(place / "capture")}
        settings.write_text(json.dumps(recorded))
        monkeypatch.chdir(place)
        if not attempt:
            assert run(command, capsys) == 0
            whole = {path.relative_to(place): content for path, content in contents(place / "out").items()}
            continue
        what, wrong = draw_fault(rng, place, inputs, outputs)
        with wrong:
            code = run(command, capsys)
        LOGGER.info("%s: %s: exit %d", name, what, code)
        left = [path.name for path in place.rglob("*") if path.name.startswith(".") or path.suffix == ".tmp"]
        assert not left, what
        if name in TIMED:
            if what.startswith(("full", "read", "occ")) and (place / "run" / "checkpoint").is_dir():
                dsar.load(place / "run")
        elif what.startswith(("full", "read")):
            there = {path.relative_to(place): content for path, content in contents(place / "out").items()}
            assert there.items() <= whole.items(), what
        shutil.rmtree(place)
