"""Unseen motions never train: with and without them a run has the same weights to the last bit."""

import shutil
from pathlib import Path

import pytest
from safetensors.torch import load_file

from dsar.cli import main
from dsar.data.captures.formats import open_capture
from tests.conftest import train_arguments
from tests.unseen_motions import add_unseen


@pytest.fixture(scope="module")
def capture(tiny_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = shutil.copytree(tiny_capture, tmp_path_factory.mktemp("unseen") / "tiny")
    add_unseen(folder, kick={}, squat={"split": "unseen_validation"})
    return folder


@pytest.fixture(scope="module")
def trained(capture: Path) -> Path:
    run = capture.parent / "run"
    main(train_arguments(capture, run, "--steps", "20", "--workers", "1"))
    return run


def test_training_does_not_change_by_a_bit(trained, tiny_capture, tmp_path):
    main(train_arguments(tiny_capture, tmp_path / "run", "--steps", "20", "--workers", "1"))
    files = sorted((trained / "checkpoint").glob("*.safetensors"))
    assert len(files) >= 4
    for path in files:
        with_unseen, without = load_file(path), load_file(tmp_path / "run" / "checkpoint" / path.name)
        assert with_unseen.keys() == without.keys()
        assert all(with_unseen[key].equal(without[key]) for key in without), path.name


def test_an_avatar_is_driven_by_an_unseen_motion_of_its_capture(trained, capture, tmp_path):
    shutil.move(capture, tmp_path / "away")
    try:
        arguments = ["--motion", "kick", "--frames", "1001-1014", "--progress", "none"]
        main(["export", str(trained), "--ply", str(tmp_path / "kick"), *arguments])
        assert len(list((tmp_path / "kick").rglob("*.ply"))) == len(
            open_capture(tmp_path / "away").motions["kick"]
        )
    finally:
        shutil.move(tmp_path / "away", capture)
