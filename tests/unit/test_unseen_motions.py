"""Unseen motions: read without images, refused where they are half of something else, kept apart."""

import json
import pickle
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from dsar.data.captures.formats import open_capture
from dsar.data.captures.multiview import UNSEEN_SPLITS
from dsar.errors import CaptureError
from dsar.evaluation.check import check_capture, draw_overlays
from dsar.training.scene import read_scene, scene_of_capture, write_scene
from tests.unseen_motions import add_unseen

PACKAGE = Path(__file__).parents[2] / "dsar"


@pytest.fixture
def folder(tiny_capture: Path, tmp_path: Path) -> Path:
    return shutil.copytree(tiny_capture, tmp_path / "capture")


@pytest.fixture
def capture(folder: Path):
    add_unseen(folder, kick={}, squat={"split": "unseen_validation"})
    return open_capture(folder)


def test_an_unseen_motion_has_motion_and_garment_and_no_images(capture, tiny_capture):
    seen = open_capture(tiny_capture)
    assert capture.splits == {**seen.splits, "unseen_test": ("kick",), "unseen_validation": ("squat",)}
    assert not set(UNSEEN_SPLITS) & set(seen.splits)
    assert (len(capture.motions["kick"]), capture.motions["kick"].name) == (14, "kick")
    np.testing.assert_allclose(capture.garment("kick")[13], [[0.113, 0.2, 0.274]], atol=1e-6)
    np.testing.assert_allclose(capture.garment("kick", 1), 2 * capture.garment("kick"), rtol=1e-6)
    assert capture.garment_runs("squat") == 2
    assert all(capture.cameras_with_image("kick", frame) == [] for frame in range(14))
    with pytest.raises(CaptureError, match="kick: an unseen motion has no images"):
        capture.image("kick", 0, 0)


def test_cropping_and_pickling_leave_unseen_motions_whole(capture):
    cropped = capture.with_frames("2-9", "1-4")
    for each in (cropped, pickle.loads(pickle.dumps(cropped))):
        assert len(each.motions["sway"]) == 8
        assert len(each.motions["kick"]) == 14
        np.testing.assert_array_equal(each.garment("kick"), capture.garment("kick"))
        assert (each.splits["unseen_test"], each.splits["unseen_validation"]) == (("kick",), ("squat",))


def test_kept_images_do_not_grow_by_motions_without_any(capture, tiny_capture):
    object.__setattr__(capture, "backdrop", True)
    seen = open_capture(tiny_capture)
    object.__setattr__(seen, "backdrop", True)
    assert 0 < capture.kept_bytes == seen.kept_bytes


def test_a_check_asks_for_no_images_of_unseen_motions(capture, tiny_capture):
    verdict, seen = check_capture(capture), check_capture(open_capture(tiny_capture))
    assert verdict.findings == seen.findings
    assert verdict.cameras == seen.cameras
    assert verdict.figures.divergence == seen.figures.divergence
    assert draw_overlays(capture)[1] == draw_overlays(open_capture(tiny_capture))[1]


def test_a_run_keeps_unseen_motions_to_drive_with(capture, tmp_path):
    scene = scene_of_capture(capture)
    write_scene(tmp_path / "scene", scene)
    kept = read_scene(tmp_path / "scene")
    assert kept.is_of(scene)
    assert kept.splits["unseen_test"] == ("kick",)
    assert list(kept.motions)[-2:] == ["kick", "squat"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"split": "train"}, "sequence kick: expected 'images' as str, found None"),
        ({"split": "test"}, "sequence kick: expected 'images' as str, found None"),
        ({"garment": None}, "sequence kick: expected 'garment' as str, found None"),
        ({"garment": "other.npz"}, "an unseen motion needs its garment; there is no .*other.npz"),
        ({"images": "images/turn"}, 'no images and no labels of split unseen_test; write "images": null'),
        ({"labels": ["nd"]}, "no images and no labels of split unseen_test"),
        ({"split": "test", "images": "images/turn", "labels": ["unseen_test"]}, "unseen_test is a split"),
        ({"split": "test", "images": "images/turn", "labels": ["train"]}, "train is a split, not a label"),
        ({"split": "unseen"}, "one of train, test, unseen_validation, unseen_test, found 'unseen'"),
    ],
)
def test_half_unseen_motions_are_refused_by_name(folder, changes, message):
    add_unseen(folder, kick=changes)
    with pytest.raises(CaptureError, match=message):
        open_capture(folder)


def test_equal_poses_are_looked_for_in_images_only(folder):
    add_unseen(folder, kick={})
    record = json.loads((folder / "capture.json").read_text())
    record["one_to_many"] = [{"sequence": "kick", "after_stop": [1, 2], "at_rest": [0, 0]}]
    (folder / "capture.json").write_text(json.dumps(record))
    with pytest.raises(CaptureError, match="no sequence 'kick' with images; there are sway, turn, bend"):
        open_capture(folder)


def test_only_readers_and_evaluation_know_of_the_half_that_is_only_reported():
    """Choices are made on `unseen_validation`: no other code can so much as name the other half."""
    name = re.compile("unseen_test|UNSEEN_SPLITS|UNSEEN_TEST")
    knowing = {
        path.relative_to(PACKAGE).parts[:2]
        for path in PACKAGE.rglob("*.py")
        if name.search(path.read_text(encoding="utf-8"))
    }
    assert {parts if parts[0] == "data" else parts[:1] for parts in knowing} <= {
        ("data", "captures"),
        ("evaluation",),
    }
