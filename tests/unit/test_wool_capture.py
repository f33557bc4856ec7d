"""The second embedded capture: another solver's cloth, small, at rest when it starts."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch

from dsar.body.skinning import forward_kinematics
from dsar.config import EMBEDDED_CAPTURES, TrainConfig, absolute_capture, with_absolute_paths
from dsar.data.captures.formats import EMBEDDED_CAPTURE, capture_of, open_capture
from dsar.errors import CaptureError

ROOT = Path(__file__).parents[2]
FOLDER = EMBEDDED_CAPTURE.parent / EMBEDDED_CAPTURES["embedded-wool"]
NAME = "embedded-wool"


@pytest.fixture(scope="module")
def wool():
    return open_capture(NAME)


@pytest.fixture(scope="module")
def floral():
    return open_capture()


def test_both_captures_show_one_body_by_the_same_cameras(wool, floral):
    assert (wool.name, len(wool.cameras)) == (NAME, 8)
    for ours, theirs in zip(wool.cameras, floral.cameras, strict=True):
        assert (ours.name, ours.width, ours.height) == (theirs.name, 192, 256)
        torch.testing.assert_close(ours.T_camera_world, theirs.T_camera_world, rtol=0, atol=0)
    torch.testing.assert_close(wool.body.vertices, floral.body.vertices, rtol=0, atol=0)


def test_images_fit_in_twelve_megabytes():
    assert sum(path.stat().st_size for path in (FOLDER / "images").iterdir()) < 12e6


def test_it_trains_on_its_own_sequences_and_keeps_far_back(wool):
    assert wool.splits["test"] == wool.splits["fd"] == ("far",)
    assert sum(len(wool.motions[name]) for name in wool.splits["train"]) >= 350
    assert not set(wool.splits["train"]) & set(wool.splits["test"])


def test_unseen_motions_are_those_of_the_first_subject(wool, floral):
    for split in ("unseen_validation", "unseen_test"):
        assert len(wool.splits[split]) >= 8
        assert set(wool.splits[split]) <= set(floral.splits[split])
        for name in wool.splits[split]:
            torch.testing.assert_close(
                wool.motions[name].rotations, floral.motions[name].rotations, rtol=0, atol=1e-6
            )


def test_training_and_unseen_motions_differ(wool):
    def digest(name: str) -> str:
        return hashlib.sha256(wool.motions[name].rotations.numpy().tobytes()).hexdigest()

    assert len({digest(name) for name in wool.motions}) == len(wool.motions)


def test_the_garment_is_a_closed_tube_that_never_explodes(wool):
    for name in wool.motions:
        faces, cloth = wool.garment_faces(name), wool.garment(name)
        edges, counts = np.unique(
            np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1),
            axis=0,
            return_counts=True,
        )
        # Only waist and hem are open: each has as many edges as the tube has columns.
        assert counts.max() == 2
        assert (counts == 1).sum() == 2 * 64
        assert np.isfinite(cloth).all()
        lengths = np.linalg.norm(cloth[:, edges[:, 0]] - cloth[:, edges[:, 1]], axis=-1)
        assert lengths.max() < 0.25
        assert np.linalg.norm(np.diff(cloth, axis=0), axis=-1).max() < 0.4


def test_the_skirt_stays_with_the_body_and_right_side_out(wool):
    for name in wool.motions:
        motion, cloth = wool.motions[name], wool.garment(name)
        pelvis = forward_kinematics(wool.body, motion.rotations, motion.translations)[:, 0, :3, 3].numpy()
        grid = (cloth - pelvis[:, None]).reshape(len(cloth), -1, 64, 3)
        assert np.linalg.norm(grid[:, 0], axis=-1).max() < 0.35
        assert (grid[:, -1, :, 1].mean(1) < grid[:, 0, :, 1].mean(1) - 0.2).all()


@pytest.mark.parametrize("name", ["far", "spin_both", "twists", "jumps", "sway"])
def test_the_cloth_is_at_rest_before_an_authored_motion_starts(wool, name):
    cloth = wool.garment(name)
    assert np.linalg.norm(cloth[1] - cloth[0], axis=-1).mean() < 0.003


def test_equal_poses_have_different_cloth_after_the_stop(wool):
    (pair,) = wool.one_to_many
    motion, cloth = wool.motions[pair.sequence], wool.garment(pair.sequence)
    stop = pair.after_stop[0]
    torch.testing.assert_close(motion.rotations[stop], motion.rotations[pair.at_rest[0]], atol=1e-6, rtol=0)
    apart = np.linalg.norm(cloth[stop] - cloth[pair.at_rest[0]], axis=-1)
    assert apart.mean() > 0.05


def test_a_second_run_is_another_outcome_of_the_same_motion(wool):
    first, second = (wool.garment("far", run) for run in (0, 1))
    between = np.sqrt(((first - second) ** 2).sum(-1).mean())
    moved = np.sqrt(((first - first[:1]) ** 2).sum(-1).mean())
    assert 0.0005 < between < 0.5 * moved


def test_the_documentation_names_the_solver():
    text = (ROOT / "docs/capture-format.md").read_text()
    assert all(word in text for word in ("embedded-wool", "Blender 4.5", "bpy 4.5"))


def test_a_run_of_an_embedded_capture_means_it_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert [absolute_capture(name) for name in EMBEDDED_CAPTURES] == list(EMBEDDED_CAPTURES)
    config = TrainConfig(capture=NAME)
    assert with_absolute_paths(config).capture == NAME
    assert capture_of(config).name == NAME
    with pytest.raises(CaptureError, match="`embedded` or `embedded-wool`"):
        open_capture("embedded_wool")
