"""Settings: presets, contradictions, config.json, and the names that settings had once."""

import dataclasses
import json
import logging
from pathlib import Path

import pytest

from dsar.cli import parse
from dsar.cli.train import Train
from dsar.config import PRESETS, TrainConfig, config_from_json, config_to_json
from dsar.config.migrations import ADDED, RENAMED, rename_settings
from dsar.errors import ConfigError

OLD = Path(__file__).parents[1] / "data" / "config-format-3.json"
"""Written by the revision before the names changed; every setting that was renamed has a value of its own."""


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_consistent_and_survive_json(preset, tmp_path):
    config = PRESETS[preset]
    config.validate()
    path = tmp_path / "config.json"
    path.write_text(config_to_json(config))
    assert config_from_json(path) == config


def test_contradictory_settings_are_refused_before_any_work():
    config = TrainConfig()
    atlas = dataclasses.replace(config.atlas, resolution=100)
    model = dataclasses.replace(config.model, upsample=4)
    with pytest.raises(ConfigError, match="multiple of 16"):
        dataclasses.replace(config, atlas=atlas, model=model).validate()
    with pytest.raises(ConfigError, match="heads"):
        dataclasses.replace(config, model=dataclasses.replace(config.model, heads=5)).validate()


def test_an_unreadable_config_says_which_file(tmp_path):
    path = tmp_path / "config.json"
    path.write_text('{"capture": "embedded", "unknown": 1}')
    with pytest.raises(ConfigError, match=r"config\.json"):
        config_from_json(path)


def test_a_config_of_the_old_names_is_read_to_the_settings_that_it_meant():
    config, old = config_from_json(OLD), json.loads(OLD.read_text())
    read = json.loads(config_to_json(config))
    for before, now in RENAMED.items():
        (section, name), (same, new) = before.split("."), now.split(".")
        assert section == same
        assert read[section][new] == old[section].pop(name), now
        assert read[section].pop(new) != dataclasses.asdict(PRESETS["small"])[section][new], now
    # Those that came later are as if they were not there.
    for name, value in ADDED.items():
        section, setting = name.split(".")
        assert read[section].pop(setting) == value
    # All others have the name that they had.
    assert read == old


def test_names_of_settings_are_migrated_to_settings_that_exist():
    settings = dataclasses.asdict(TrainConfig())
    for before, now in RENAMED.items():
        section, name = now.split(".")
        assert name in settings[section]
        assert before.split(".")[1] not in settings[section]


def test_a_setting_by_both_its_names_or_by_none_that_ever_was_is_refused_by_name(tmp_path):
    path, old = tmp_path / "config.json", json.loads(OLD.read_text())
    for section, name, complaint in (
        ("schedule", "rollouts_per_worker", r"unknown: schedule\.streams"),
        ("schedule", "brooks", r"unknown: schedule\.brooks"),
        ("loss", "streams", r"unknown: loss\.streams"),
    ):
        path.write_text(json.dumps(old | {section: old[section] | {name: 4}}))
        with pytest.raises(ConfigError, match=complaint):
            config_from_json(path)
    assert rename_settings([1, 2]) == [1, 2]


def flags_of(settings: dict) -> list[str]:
    """Return the settings as the flags that say them."""
    flags = []
    for section in ("atlas", "model", "loss", "schedule"):
        for name, value in settings[section].items():
            key = f"{section}.{name}".replace("_", "-")
            if isinstance(value, bool):
                flags.append(f"--{key}" if value else f"--{section}.no-{name}".replace("_", "-"))
            else:
                flags += [f"--{key}", *map(str, value if isinstance(value, list) else [value])]
    return flags


def test_old_flags_go_on_working_and_say_the_new_names(caplog):
    old = json.loads(OLD.read_text())
    with caplog.at_level(logging.WARNING):
        later = [part for name, value in ADDED.items() for part in (f"--{name}", str(value))]
        command = parse(["train", "--preset", "small", "--seed", "7", *flags_of(old), *later])
    assert isinstance(command, Train)
    assert command.config() == config_from_json(OLD)
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == len(RENAMED)
    assert "--schedule.streams is called --schedule.rollouts-per-worker now" in lines


@pytest.mark.parametrize("flag", ["--schedule.template_share=0.3", "--schedule.template-share=0.3"])
def test_old_flags_may_be_spelt_as_flags_may(flag):
    command = parse(["train", flag])
    assert isinstance(command, Train)
    assert command.schedule.template_fraction == 0.3


def test_a_flag_that_never_was_is_refused_by_name(capsys):
    with pytest.raises(SystemExit) as stop:
        parse(["train", "--schedule.brooks", "4"])
    assert stop.value.code == 2
    assert "--schedule.brooks" in capsys.readouterr().err
