"""What the command line makes of what is typed."""

import dataclasses
from pathlib import Path

import pytest

from dsar.cli import parse
from dsar.cli.command import file_stem
from dsar.cli.train import Train
from dsar.config import PRESETS
from dsar.training.report import Monitor, UpdateMetrics


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize(
    "spelling",
    [
        ("--preset", "{}"),
        ("--preset={}",),
        ("--seed", "3", "--preset={}"),
        ("--preset=demo", "--preset", "{}"),
    ],
)
def test_a_preset_brings_its_settings_however_it_is_spelt(preset, spelling):
    command = parse(["train", *(word.format(preset) for word in spelling)])
    assert isinstance(command, Train)
    expected = dataclasses.replace(PRESETS[preset], seed=command.seed)
    assert command.config() == expected


def test_flags_override_the_preset_on_either_side_of_it():
    for words in (["--model.window", "3", "--preset=paper"], ["--preset=paper", "--model.window", "3"]):
        config = parse(["train", *words]).config()
        assert config.model == dataclasses.replace(PRESETS["paper"].model, window=3)
        assert config.schedule == PRESETS["paper"].schedule


@pytest.mark.parametrize("command", ["check", "export", "render", "eval", "stress", "crosscheck"])
def test_a_seed_is_asked_for_only_where_something_is_random(command, capsys):
    with pytest.raises(SystemExit):
        parse([command, "--seed", "1"])
    assert "--seed" in capsys.readouterr().err
    assert parse(["train", "--seed", "1"]).config().seed == 1


def test_the_time_left_is_judged_by_what_this_process_did(tmp_path):
    """A run that goes on at 90 % and does a hundredth in ten seconds has ninety more before it."""
    lines = []
    monitor = Monitor(tmp_path / "metrics.jsonl", 1000, lines.append, began=0.9)
    monitor.update(UpdateMetrics(1.0, 0.01))
    monitor.write(900, 0.9, "autoregressive", 0.0)
    monitor.write(910, 0.91, "autoregressive", 10.0)
    assert lines[0].seconds_left is None
    assert lines[1].seconds_left == pytest.approx(90)


def test_a_label_from_a_file_is_a_name_and_no_path():
    for label in ("../../../evil", "/etc/passwd", "..", ".", "", "a/b\\c", "C:\\a", "a\0b", "Anna, take 2"):
        stem = file_stem(label)
        assert Path(stem).name == stem
        assert stem not in (".", "..", "")
        assert not set(stem) & set("/\\.:\0")
    assert file_stem("Käte_動き-2") == "Käte_動き-2"
