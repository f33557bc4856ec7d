"""A run of format 3, as the revision wrote it in which tensors had other names: it plays and goes on alike.

tests/data/run-format-3.zip holds a small run of the embedded capture without the body's own arrays, which the
package embeds, and what that revision computed from it: Gaussians and maps. The losses after `--resume` are
of the first revision that gave each rollout random numbers of its own; the one before it still had those of
format 3.
"""

import json
import zipfile
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

import dsar
from dsar.avatar.rollout import network_outputs, roll_out
from dsar.body.files import load_body
from dsar.cli import main
from dsar.data.captures.formats import capture_of
from dsar.errors import CheckpointError
from dsar.training import loop
from dsar.training.checkpoint import FORMAT_VERSION, Run, load_checkpoint, read_progress
from dsar.training.migrations import AVATAR_NAMES

PACKED = Path(__file__).parents[1] / "data" / "run-format-3.zip"


@pytest.fixture
def old(tmp_path) -> Path:
    """The run, with the arrays of the embedded body."""
    with zipfile.ZipFile(PACKED) as file:
        file.extractall(tmp_path / "run")
    path, body = tmp_path / "run" / "checkpoint" / "avatar.safetensors", load_body()
    arrays = ("vertices", "faces", "joints", "weights", "uv", "uv_faces")
    tensors = load_file(path) | {f"body_{name}": getattr(body, name).contiguous() for name in arrays}
    save_file(tensors, path)
    return tmp_path / "run"


def test_its_avatar_moves_as_it_did(old):
    expected = load_file(old / "expected.safetensors")
    avatar, config, _ = load_checkpoint(Run(old))
    assert len(avatar.garment_texels()) > 0
    motion = capture_of(config).motions["sway"]
    with torch.no_grad():
        for number, gaussians in roll_out(avatar, motion, frames=[1001, 1003, 1006]):
            torch.testing.assert_close(gaussians.means, expected[f"means.{number}"], atol=1e-5, rtol=0)
        output = [output for _, output in network_outputs(avatar, motion)][5]
    torch.testing.assert_close(output.offset, expected["offset"], atol=1e-5, rtol=0)
    torch.testing.assert_close(output.appearance, expected["appearance"], atol=1e-5, rtol=0)


def test_it_goes_on_with_the_losses_that_it_had_by_the_command_that_began_it(old, monkeypatch):
    monkeypatch.setattr(loop, "REPORT_EVERY", 1)
    expected = json.loads((old / "expected.json").read_text())
    before = len((old / "metrics.jsonl").read_text().splitlines())
    main(["train", *expected["flags"], "--out", str(old), "--resume", "--progress", "none"])
    lines = [json.loads(line) for line in (old / "metrics.jsonl").read_text().splitlines()][before:]
    assert [line["loss"] for line in lines] == pytest.approx(expected["losses"], rel=1e-4)
    means = load_checkpoint(Run(old))[0].template.means
    wanted = load_file(old / "expected.safetensors")["resumed.means"]
    torch.testing.assert_close(means.detach(), wanted, atol=1e-4, rtol=0)
    # It is one of today's format from then on, and the report knows its old stages.
    assert read_progress(Run(old)).format_version == FORMAT_VERSION
    assert not (old / "checkpoint" / "rollouts-0.json").exists()
    assert "pretraining" in (old / "report.html").read_text()


def test_every_tensor_that_was_renamed_is_in_it():
    """The table has no name that nothing shows to be right."""
    with zipfile.ZipFile(PACKED) as file:
        header = file.read("checkpoint/avatar.safetensors")
    names = json.loads(header[8 : 8 + int.from_bytes(header[:8], "little")])
    shown = {old for old in AVATAR_NAMES if any(name == old or name.startswith(old) for name in names)}
    # The offsets' own pyramid is of another wiring.
    assert set(AVATAR_NAMES) - shown == {"network.encoder.offsets."}


@pytest.mark.parametrize("version", [2, FORMAT_VERSION + 1])
def test_other_formats_are_refused_in_one_line(old, version):
    path = old / "checkpoint" / "progress.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format_version": version}))
    with pytest.raises(CheckpointError, match=f"has format {version}, this version reads 3 to 4"):
        dsar.load(old)


def test_cursors_that_are_damaged_are_named_by_their_file(old, capsys):
    path = old / "checkpoint" / "rollouts-0.json"
    path.write_text(path.read_text()[:20])
    flags = json.loads((old / "expected.json").read_text())["flags"]
    with pytest.raises(SystemExit) as stop:
        main(["train", *flags, "--out", str(old), "--resume", "--progress", "none"])
    assert stop.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"dsar: {path}: ")
