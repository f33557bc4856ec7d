"""Which way is up is found from how people stand, and not from how they lie."""

import dataclasses
import logging
import re
from pathlib import Path

import numpy as np
import pytest
import torch

import dsar.data.motions.files as motion_files
from dsar.body.files import load_body
from dsar.data.motions.files import EMBEDDED_MOTIONS, read_motion, rotate_motion, write_motion
from dsar.data.motions.kinematics import trace_joints
from dsar.data.motions.plausibility import check_plausibility
from dsar.data.motions.smplx_npz import read_arrays, read_poses, read_rate
from dsar.data.motions.up_axis import detect_up_axis, rotation_to_y_up
from dsar.errors import MotionError
from dsar.types import Body, Motion

CLIPS = [
    *sorted((Path(motion_files.__file__).parents[1] / "embedded" / "motion").glob("*.npz")),
    *sorted(EMBEDDED_MOTIONS.glob("*.npz")),
]
ON_THE_BACK = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@pytest.fixture(scope="module")
def body() -> Body:
    return load_body()


@pytest.fixture(scope="module")
def walk(body: Body) -> Motion:
    return read_motion(next(clip for clip in CLIPS if clip.stem == "walk"), body)


@pytest.fixture(scope="module")
def lying(body: Body, walk: Motion) -> Motion:
    """The walker on the floor, away from the origin."""
    motion = rotate_motion(walk, body, ON_THE_BACK)
    low = trace_joints(body, motion).positions[..., 1].min()
    shift = torch.tensor([1.5, 0.05 - float(low), 1.0])
    return dataclasses.replace(motion, translations=motion.translations + shift)


def chained(*motions: Motion) -> Motion:
    rotations, translations = (
        torch.cat([getattr(motion, name) for motion in motions]) for name in ("rotations", "translations")
    )
    return Motion(rotations, translations, motions[0].fps)


def written(path: Path, motion: Motion, **changes: np.ndarray) -> Path:
    arrays = {
        "poses": motion.rotations.flatten(1).numpy(),
        "trans": motion.translations.numpy(),
        "mocap_frame_rate": np.array(motion.fps),
    }
    np.savez(path, allow_pickle=False, **arrays | changes)
    return path


@pytest.mark.parametrize("clip", CLIPS, ids=lambda clip: clip.stem)
def test_embedded_clips_are_read_as_z_up_bit_for_bit_and_nothing_is_wrong_with_them(
    body: Body, clip: Path
) -> None:
    motion, arrays = read_motion(clip, body), read_arrays(clip)
    z_up = Motion(*read_poses(clip, arrays), read_rate(clip, arrays), clip.stem)
    turn = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    expected = rotate_motion(z_up, body, turn)
    assert torch.equal(motion.rotations, expected.rotations)
    assert torch.equal(motion.translations, expected.translations)
    assert check_plausibility(trace_joints(body, motion)) == []


def test_the_same_motion_with_y_or_z_up_moves_every_vertex_alike(
    tmp_path: Path, body: Body, walk: Motion
) -> None:
    write_motion(tmp_path / "z.npz", walk, body)
    written(tmp_path / "y.npz", walk)
    y_up, z_up = (read_motion(tmp_path / f"{name}.npz", body) for name in "yz")
    assert torch.equal(y_up.rotations, walk.rotations)
    assert torch.equal(y_up.translations, walk.translations)
    assert torch.allclose(trace_joints(body, y_up).positions, trace_joints(body, z_up).positions, atol=1e-5)


@pytest.mark.parametrize("axis", ["y", "-y", "z", "-z", "x", "-x"])
def test_any_axis_may_be_up(tmp_path: Path, body: Body, walk: Motion, axis: str) -> None:
    turned = rotate_motion(walk, body, rotation_to_y_up(axis).T)
    # As in the frame of a camera four metres away, with the feet on no floor.
    turned = dataclasses.replace(turned, translations=turned.translations + torch.tensor([0.3, 0.5, 4.0]))
    found = trace_joints(body, read_motion(written(tmp_path / "m.npz", turned), body)).positions
    shift = rotation_to_y_up(axis) @ torch.tensor([0.3, 0.5, 4.0])
    assert torch.allclose(found, trace_joints(body, walk).positions + shift, atol=1e-5)


def test_quarter_turns_are_rotations_that_bring_their_axis_up() -> None:
    for sign in (1.0, -1.0):
        for index, letter in enumerate("xyz"):
            turn = rotation_to_y_up(("-" if sign < 0 else "") + letter)
            assert torch.equal(turn @ turn.T, torch.eye(3))
            assert torch.linalg.det(turn) == 1
            assert torch.equal(turn @ (sign * torch.eye(3)[index]), torch.tensor([0.0, 1.0, 0.0]))


@pytest.mark.parametrize("up", ["y", "z"])
def test_who_lies_most_of_the_time_is_not_stood_up(
    tmp_path: Path, body: Body, walk: Motion, lying: Motion, up: str
) -> None:
    motion = chained(lying, lying, walk)
    path = written(tmp_path / "m.npz", rotate_motion(motion, body, rotation_to_y_up(up).T))
    assert torch.allclose(
        trace_joints(body, read_motion(path, body)).positions, trace_joints(body, motion).positions, atol=1e-5
    )


def test_who_lies_all_the_time_is_as_the_format_has_it_with_a_warning(
    tmp_path: Path, body: Body, lying: Motion, caplog: pytest.LogCaptureFixture
) -> None:
    write_motion(tmp_path / "swim.npz", lying, body)
    motion = read_motion(tmp_path / "swim.npz", body)
    assert torch.allclose(
        trace_joints(body, motion).positions, trace_joints(body, lying).positions, atol=1e-5
    )
    assert "say --up y" in caplog.messages[0]
    assert [record.levelno for record in caplog.records] == [logging.WARNING]


def test_who_stands_about_the_origin_without_a_floor_is_not_taken_for_lying(
    tmp_path: Path, body: Body, walk: Motion
) -> None:
    """Fits of one person are often given about the root."""
    near = dataclasses.replace(walk, translations=0.1 * (walk.translations - walk.translations.mean(0)))
    motion = read_motion(written(tmp_path / "fit.npz", near), body)
    assert torch.equal(motion.rotations, near.rotations)


def test_the_told_axis_is_taken_over_what_the_motion_shows(tmp_path: Path, body: Body, walk: Motion) -> None:
    path = written(tmp_path / "m.npz", walk)
    expected = trace_joints(body, walk).positions @ rotation_to_y_up("z").T
    assert torch.allclose(trace_joints(body, read_motion(path, body, up="z")).positions, expected, atol=1e-5)
    assert torch.equal(read_motion(path, body, up="y").rotations, walk.rotations)


def test_who_sits_on_a_floor_is_upright(body: Body, walk: Motion) -> None:
    seated = dataclasses.replace(walk, rotations=walk.rotations.clone())
    seated.rotations[:, 1:3] = torch.tensor([-1.5, 0.0, 0.0])
    assert detect_up_axis(trace_joints(body, seated).positions, "z").axis == "y"


def lifted(motion: Motion, *shift: float) -> Motion:
    return dataclasses.replace(motion, translations=motion.translations + torch.tensor(shift))


def jumping(motion: Motion) -> Motion:
    place = motion.translations.clone()
    place[40:] += torch.tensor([2.0, 0.0, 0.0])
    return dataclasses.replace(motion, translations=place)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda body, walk: rotate_motion(walk, body, ON_THE_BACK), "the figure lies; .*--up y or --up z"),
        (
            lambda body, walk: lifted(rotate_motion(walk, body, rotation_to_y_up("-y")), 0, 2, 0),
            "is upside down",
        ),
        (lambda body, walk: lifted(walk, 0, 0.5, 0), r"nearer than 0\.5\d m to the ground"),
        (lambda body, walk: lifted(walk, 0, -0.9, 0), r"under the ground at y = 0, by 0\.8\d m, in 100%"),
        (lambda body, walk: lifted(walk, 30, 0, 0), "is 30 m away from the origin"),
        (lambda body, walk: jumping(walk), r"jump 1\.99 m .* frame 39.*--motion-fps"),
        (lambda body, walk: dataclasses.replace(walk, translations=100 * walk.translations), "metres"),
    ],
)
def test_what_is_wrong_with_a_motion_is_named_with_its_remedy(
    body: Body, walk: Motion, make, message: str, caplog: pytest.LogCaptureFixture
) -> None:
    faults = check_plausibility(trace_joints(body, make(body, walk)))
    assert faults
    assert caplog.messages == [f"Motion {walk.name}: {fault}" for fault in faults]
    assert re.search(message, "; ".join(faults)), faults


def test_who_cannot_be_is_refused(body: Body, walk: Motion) -> None:
    folded = walk.rotations.clone()
    folded[:, 1:3] = torch.tensor([-2.9, 0.0, 0.0])
    with pytest.raises(MotionError, match=r"folded onto its legs in 100% of the frames"):
        check_plausibility(trace_joints(body, dataclasses.replace(walk, rotations=folded)))
    with pytest.raises(MotionError, match="not finite"):
        check_plausibility(
            trace_joints(body, dataclasses.replace(walk, translations=walk.translations * float("nan")))
        )
