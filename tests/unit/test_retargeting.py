"""One motion in many makers' .bvh moves our body alike, whatever they call joints and however they rest."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from skeletons import BODY, CMU, LAFAN1, LAYOUTS, MIXAMO, ROKOKO, XSENS, Layout, world_joints, write_layout

import dsar.data.motions.files as motion_files
from dsar.body.files import load_body
from dsar.data.motions.files import EMBEDDED_MOTIONS, read_motion
from dsar.data.motions.kinematics import trace_joints
from dsar.data.motions.plausibility import check_plausibility
from dsar.errors import MotionError
from dsar.types import Body, Motion

UNREAL = dataclasses.replace(
    LAFAN1,
    centre=("pelvis", "spine_01", "spine_02", "spine_03", "neck_01", "head"),
    arm=("clavicle_{}", "upperarm_{}", "lowerarm_{}", "hand_{}"),
    leg=("thigh_{}", "calf_{}", "foot_{}", "ball_{}"),
    sides=("l", "r"),
)
SMPL = dataclasses.replace(
    CMU,
    centre=("Pelvis", "Spine1", "Spine2", "Spine3", "Neck", "Head"),
    arm=("{}_Collar", "{}_Shoulder", "{}_Elbow", "{}_Wrist"),
    leg=("{}_Hip", "{}_Knee", "{}_Ankle", "{}_Foot"),
    sides=("L", "R"),
    prefix="m_avg_",
)
OTHERS = {
    "unreal": UNREAL,
    "smpl": SMPL,
    "an A-pose turned by 37 degrees": dataclasses.replace(CMU, rest="A", turned=(0.0, 37.0, 0.0)),
    "resting on its back": dataclasses.replace(CMU, turned=(-90.0, 0.0, 0.0)),
    "resting on its side": dataclasses.replace(MIXAMO, turned=(0.0, 0.0, 90.0)),
    "resting upside down": dataclasses.replace(MIXAMO, turned=(180.0, 0.0, 0.0)),
    "X up": dataclasses.replace(ROKOKO, world=(0.0, 0.0, -90.0)),
    "Y down": dataclasses.replace(XSENS, world=(180.0, 0.0, 0.0), turned=(180.0, 0.0, 0.0)),
    "bones in a line, Z up, inches": dataclasses.replace(LAFAN1, world=(90.0, 0.0, 0.0), unit=0.0254),
}


@pytest.fixture(scope="module")
def body() -> Body:
    return load_body()


@pytest.fixture(scope="module")
def walk(body: Body) -> Motion:
    return read_motion(Path(motion_files.__file__).parents[1] / "embedded" / "motion" / "walk.npz", body)


@pytest.fixture(scope="module")
def climb(body: Body) -> Motion:
    motion = read_motion(EMBEDDED_MOTIONS / "cmu_01_03.npz", body)
    return dataclasses.replace(
        motion, rotations=motion.rotations[::10], translations=motion.translations[::10], fps=3.0
    )


def joint_error(body: Body, motion: Motion, expected: Motion) -> float:
    places, truth = (world_joints(body, each)[1][:, : len(BODY)] for each in (motion, expected))
    return float(np.linalg.norm(places - truth, axis=-1).max())


@pytest.mark.parametrize("name", [*LAYOUTS, *OTHERS])
def test_a_motion_in_any_layout_brings_every_joint_to_the_same_place(
    tmp_path: Path, body: Body, walk: Motion, name: str
) -> None:
    path = write_layout(tmp_path / "walk.bvh", (LAYOUTS | OTHERS)[name], body, walk)
    motion = read_motion(path, body)
    assert motion.fps == 30.0
    # The files have six decimals of a degree and of a unit.
    assert joint_error(body, motion, walk) < 1e-4
    assert check_plausibility(trace_joints(body, motion)) == []


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_climb_in_any_layout_brings_every_joint_to_the_same_place(
    tmp_path: Path, body: Body, climb: Motion, name: str
) -> None:
    path = write_layout(tmp_path / "climb.bvh", LAYOUTS[name], body, climb)
    assert joint_error(body, read_motion(path, body), climb) < 1e-4


@pytest.mark.parametrize("name", [name for name, layout in LAYOUTS.items() if layout.rest != "line"])
def test_a_skeleton_that_rests_as_a_person_stands_gives_the_rolls_of_limbs_too(
    tmp_path: Path, body: Body, walk: Motion, name: str
) -> None:
    motion = read_motion(write_layout(tmp_path / "walk.bvh", LAYOUTS[name], body, walk), body)
    turns, truth = (world_joints(body, each)[0][:, : len(BODY)] for each in (motion, walk))
    np.testing.assert_allclose(turns, truth, atol=2e-3)


def test_bones_in_a_line_roll_limbs_as_knees_and_elbows_bend(
    tmp_path: Path, body: Body, walk: Motion
) -> None:
    motion = read_motion(write_layout(tmp_path / "walk.bvh", LAFAN1, body, walk), body)
    turns, truth = (world_joints(body, each)[0][:, : len(BODY)] for each in (motion, walk))
    cosines = (np.einsum("fjik,fjik->fj", turns, truth) - 1) / 2
    angles = np.degrees(np.arccos(cosines.clip(-1, 1)))
    legs = [BODY.index(f"{side}_{joint}") for side in ("left", "right") for joint in ("hip", "knee")]
    assert angles[:, legs].max() < 3
    # CMU's arms, of which the walk is made, bend about an axis 30 degrees off the anatomy's.
    assert angles.max() < 35


@pytest.mark.parametrize(("layout", "degrees"), [(CMU, 0.1), (LAFAN1, 35)], ids=["cmu", "lafan1"])
def test_end_sites_that_point_anywhere_turn_no_hand_and_no_head(
    tmp_path: Path, body: Body, walk: Motion, layout: Layout, degrees: float
) -> None:
    """Exporters that know no end of a bone write 0 0 1."""
    path = write_layout(tmp_path / "walk.bvh", layout, body, walk)
    path.write_text(re.sub(r"(End Site\s*{\s*OFFSET) .*", r"\1 0 0 1", path.read_text()))
    turns, truth = (world_joints(body, each)[0] for each in (read_motion(path, body), walk))
    ends = [BODY.index(name) for name in ("left_wrist", "right_wrist", "head")]
    cosines = (np.einsum("fjik,fjik->fj", turns[:, ends], truth[:, ends]) - 1) / 2
    assert np.degrees(np.arccos(cosines.clip(-1, 1))).max() < degrees


def test_fewer_joints_than_ours_bring_limbs_within_two_centimetres(
    tmp_path: Path, body: Body, walk: Motion
) -> None:
    layout = Layout(
        ("Hips", "", "Ab", "Chest", "Neck", "Head"),
        ("", "{}Shoulder", "{}Elbow", "{}Wrist"),
        ("{}Hip", "{}Knee", "{}Ankle", ""),
    )
    motion = read_motion(write_layout(tmp_path / "few.bvh", layout, body, walk), body)
    legs = [BODY.index(f"{side}_{joint}") for side in ("left", "right") for joint in ("hip", "knee", "ankle")]
    places, truth = (world_joints(body, each)[1] for each in (motion, walk))
    assert np.linalg.norm(places - truth, axis=-1)[:, legs].max() < 1e-4
    assert np.linalg.norm(places - truth, axis=-1)[:, : len(BODY)].max() < 0.02


@pytest.mark.parametrize("layout", [MIXAMO, LAFAN1], ids=["mixamo", "lafan1"])
def test_joints_without_names_are_placed_by_the_figures_shape(
    tmp_path: Path, body: Body, walk: Motion, layout: Layout
) -> None:
    path = write_layout(tmp_path / "walk.bvh", layout, body, walk)
    numbers = iter(range(100))
    path.write_text(
        re.sub(r"(ROOT|JOINT) .*", lambda word: f"{word[1]} 関節{next(numbers)}", path.read_text())
    )
    assert joint_error(body, read_motion(path, body), walk) < 1e-4


def test_a_shape_that_is_no_persons_is_refused_with_what_it_lacks(
    tmp_path: Path, body: Body, walk: Motion
) -> None:
    layout = dataclasses.replace(MIXAMO, arm=("{}Shoulder", "{}Wing", "{}Feather", ""), fingers=False)
    path = write_layout(tmp_path / "bird.bvh", layout, body, walk)
    with pytest.raises(
        MotionError, match="lacks the joints left elbow, left wrist, right elbow, right wrist"
    ):
        read_motion(path, body)


def test_what_a_file_was_taken_for_is_said_in_one_line(
    tmp_path: Path, body: Body, walk: Motion, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_layout(tmp_path / "walk.bvh", XSENS, body, walk)
    with caplog.at_level("INFO"):
        read_motion(path, body)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert caplog.messages == [
        "walk.bvh: Z up (the trunk is upright in 100% of the frames; if that is wrong, say --up y), "
        "23 joints by their names, rest standing, turned, 1 unit = 0.0254 m (legs), 30 fps"
    ]
