"""Motion files: what is written is read back, Z-up files land Y-up, broken ones are refused."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from dsar.body.files import load_body
from dsar.body.model import FACE_JOINTS, JOINT_NAMES
from dsar.body.skinning import pose_vertices
from dsar.data.motions.files import EMBEDDED_MOTIONS, read_motion, resample, write_motion
from dsar.errors import MotionError
from dsar.geometry.rotations import matrix_from_axis_angle
from dsar.types import Body, Motion, Pose

HANDS = slice(FACE_JOINTS.stop, None)


@pytest.fixture(scope="module")
def body() -> Body:
    return load_body()


def random_motion(frames: int, fps: float = 30.0) -> Motion:
    generator = torch.Generator().manual_seed(0)
    rotations = 0.5 * torch.randn(frames, len(JOINT_NAMES), 3, generator=generator)
    return Motion(rotations, torch.randn(frames, 3, generator=generator), fps)


def amass(frames: int = 4, columns: int = 165) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(0)
    return {
        "poses": 0.5 * generator.standard_normal((frames, columns)),
        "trans": generator.standard_normal((frames, 3)),
        "mocap_framerate": np.array(120.0),
        "betas": np.zeros(16),
        "gender": np.array("female"),
    }


def write_npz(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    np.savez(path, allow_pickle=False, **arrays)
    return path


def test_written_motion_is_read_back(body: Body, tmp_path: Path) -> None:
    motion = random_motion(7, fps=29.97)
    path = tmp_path / "walk.npz"
    write_motion(path, motion, body)
    back = read_motion(path, body)
    assert (back.fps, back.name, len(back)) == (29.97, "walk", 7)
    turns = [matrix_from_axis_angle(m.rotations) for m in (motion, back)]
    assert torch.allclose(turns[0], turns[1], atol=1e-5)
    assert torch.allclose(motion.translations, back.translations, atol=1e-6)
    assert [entry.name for entry in tmp_path.iterdir()] == ["walk.npz"]


def test_z_up_file_poses_the_same_body_turned_y_up(body: Body, tmp_path: Path) -> None:
    arrays = amass()
    motion = read_motion(write_npz(tmp_path / "m.npz", arrays), body, up="z")
    assert motion.fps == 120.0
    rotations = torch.from_numpy(arrays["poses"]).float().unflatten(1, (-1, 3))
    z_up = pose_vertices(body, Pose(rotations[2], torch.from_numpy(arrays["trans"][2]).float()))
    y_up = torch.stack([z_up[:, 0], z_up[:, 2], -z_up[:, 1]], 1)
    assert torch.allclose(pose_vertices(body, motion[2]), y_up, atol=1e-5)


@pytest.mark.parametrize(("columns", "hands"), [(156, slice(66, 156)), (72, None), (66, None)])
def test_shorter_skeletons_keep_body_and_hands_and_rest_elsewhere(
    body: Body, tmp_path: Path, columns: int, hands: slice | None
) -> None:
    arrays = amass(columns=columns)
    motion = read_motion(write_npz(tmp_path / "m.npz", arrays), body)
    body_poses = torch.from_numpy(arrays["poses"][:, 3:66]).float().unflatten(1, (-1, 3))
    assert torch.equal(motion.rotations[:, 1 : FACE_JOINTS.start], body_poses)
    assert motion.rotations[:, list(FACE_JOINTS)].abs().max() == 0
    if hands is None:
        assert motion.rotations[:, HANDS].abs().max() == 0
    else:
        expected = torch.from_numpy(arrays["poses"][:, hands]).float().unflatten(1, (-1, 3))
        assert torch.equal(motion.rotations[:, HANDS], expected)


def test_split_keys_of_amass_and_of_smplx_say_the_same_as_poses(body: Body, tmp_path: Path) -> None:
    whole = amass()
    poses = whole.pop("poses")
    expected = read_motion(write_npz(tmp_path / "m.npz", {"poses": poses, **whole}), body)
    bounds = {"amass": (3, 66, 69, 75), "smplx": (3, 66, 69, 72, 75, 120)}
    keys = {
        "amass": ("root_orient", "pose_body", "pose_jaw", "pose_eye", "pose_hand"),
        "smplx": (
            *("global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose"),
            *("left_hand_pose", "right_hand_pose"),
        ),
    }
    for kind, names in keys.items():
        parts = dict(zip(names, np.split(poses, bounds[kind], axis=1), strict=True))
        motion = read_motion(write_npz(tmp_path / "m.npz", parts | whole), body)
        assert torch.equal(motion.rotations, expected.rotations), kind


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trans": None}, "lacks trans or transl; it has poses, mocap_framerate"),
        ({"mocap_framerate": None}, "lacks mocap_frame_rate"),
        ({"mocap_framerate": np.array(0.0)}, "above 0"),
        ({"poses": None}, "lacks root_orient or global_orient or poses"),
        ({"poses": np.zeros((4, 100))}, r"expected \(frames, 165"),
        ({"poses": np.zeros((0, 165)), "trans": np.zeros((0, 3))}, "no frames"),
        ({"trans": np.zeros((3, 3))}, r"expected \(4, 3\)"),
        ({"trans": np.full((4, 3), np.nan)}, "not finite, first at frame 0"),
        ({"poses": np.array("text")}, "cannot be read"),
        ({"poses": None, "root_orient": np.zeros((4, 3)), "pose_body": np.zeros((4, 60))}, "pose_body has"),
    ],
)
def test_broken_file_is_refused_with_its_name_and_fault(
    body: Body, tmp_path: Path, changes: dict[str, np.ndarray | None], message: str
) -> None:
    arrays = {key: value for key, value in (amass() | changes).items() if value is not None}
    path = write_npz(tmp_path / "broken.npz", arrays)
    with pytest.raises(MotionError, match=message) as error:
        read_motion(path, body)
    assert str(path) in str(error.value)


def arrangements(poses: np.ndarray, trans: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    return {
        "frames, joints, 3": (poses.reshape(len(poses), -1, 3), trans),
        "a batch of one": (poses[None], trans[None]),
        "a frame a column": (poses.T, trans.T),
        "float32": (poses.astype(np.float32), trans.astype(np.float32)),
    }


@pytest.mark.parametrize("how", ["frames, joints, 3", "a batch of one", "a frame a column", "float32"])
def test_any_arrangement_with_one_meaning_is_read(body: Body, tmp_path: Path, how: str) -> None:
    arrays = amass(frames=7)
    expected = read_motion(write_npz(tmp_path / "m.npz", arrays), body)
    poses, trans = arrangements(arrays["poses"], arrays["trans"])[how]
    motion = read_motion(write_npz(tmp_path / "m.NPZ.npz", arrays | {"poses": poses, "trans": trans}), body)
    assert torch.equal(motion.rotations, expected.rotations)
    assert torch.equal(motion.translations, expected.translations)


def test_a_single_pose_is_a_motion_of_one_frame(body: Body, tmp_path: Path) -> None:
    arrays = amass(frames=1)
    expected = read_motion(write_npz(tmp_path / "m.npz", arrays), body)
    single = arrays | {"poses": arrays["poses"][0], "trans": arrays["trans"][0]}
    assert torch.equal(read_motion(write_npz(tmp_path / "m.npz", single), body).rotations, expected.rotations)


def test_smpl_fits_in_parts_are_read_and_compressed_hands_stay_at_rest(
    body: Body, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    arrays = amass(columns=72)
    poses = arrays.pop("poses")
    expected = read_motion(write_npz(tmp_path / "m.npz", {"poses": poses, **arrays}), body)
    parts = {
        "global_orient": poses[:, None, :3],
        "body_pose": poses[:, 3:],
        "left_hand_pose": np.ones((4, 12)),
    }
    motion = read_motion(write_npz(tmp_path / "m.npz", parts | arrays), body)
    assert torch.equal(motion.rotations, expected.rotations)
    assert "left_hand_pose is given by principal components: hands stay at rest" in caplog.text


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((4, 220), "quaternions"),
        ((4, 55, 4), "quaternions"),
        ((4, 330), "six-dimensional"),
        ((4, 22, 6), "six-dimensional"),
        ((4, 55, 3, 3), "rotation matrices"),
        ((2, 4, 165), r"expected \(frames, 165"),
    ],
)
def test_other_rotations_and_several_people_are_refused_by_name(
    body: Body, tmp_path: Path, shape: tuple[int, ...], message: str
) -> None:
    with pytest.raises(MotionError, match=message):
        read_motion(write_npz(tmp_path / "m.npz", amass() | {"poses": np.ones(shape)}), body)


def test_degrees_are_refused_by_name(body: Body, tmp_path: Path) -> None:
    arrays = amass()
    with pytest.raises(MotionError, match=r"joints turn by \d+ radians or more; the poses are in degrees"):
        read_motion(write_npz(tmp_path / "m.npz", arrays | {"poses": np.rad2deg(arrays["poses"])}), body)


def test_a_rate_that_a_file_lacks_can_be_told(body: Body, tmp_path: Path) -> None:
    arrays = amass()
    path = write_npz(tmp_path / "m.npz", {key: arrays[key] for key in ("poses", "trans")})
    with pytest.raises(MotionError, match="its frame rate is unknown; say it with --motion-fps"):
        read_motion(path, body)
    assert read_motion(path, body, fps=25.0).fps == 25.0
    assert read_motion(write_npz(path, arrays), body, fps=25.0).fps == 25.0
    with pytest.raises(MotionError, match="--motion-fps 0, expected frames per second above 0"):
        read_motion(path, body, fps=0.0)


def test_foreign_files_under_the_name_npz_are_refused_for_what_they_are(body: Body, tmp_path: Path) -> None:
    path = tmp_path / "m.npz"
    with (tmp_path / "m.npy").open("wb") as stream:
        np.save(stream, np.zeros((5, 165)))
    whole = write_npz(tmp_path / "whole.npz", amass()).read_bytes()
    contents = {
        "it is a single .npy array": (tmp_path / "m.npy").read_bytes(),
        "it is a pickle": pickle.dumps({"poses": 1}),
        "it is a .bvh": b"HIERARCHY\nROOT Hips",
        "it is empty": b"",
        "it is no .npz archive": b"poses",
        "it is cut, its end is missing": whole[:3],
        "it is cut": whole[:-30],
    }
    for message, content in contents.items():
        path.write_bytes(content)
        with pytest.raises(MotionError, match=message):
            read_motion(path, body)
    np.savez(path, poses=np.array([{"a": 1}], dtype=object))
    with pytest.raises(MotionError, match="holds Python objects, which could run code"):
        read_motion(path, body)


@pytest.mark.parametrize(("suffix", "hint"), [(".pkl", "as .npz"), (".PT", "as .npz"), (".fbx", r"as \.bvh")])
def test_other_formats_are_refused_with_the_way_to_ours(
    body: Body, tmp_path: Path, suffix: str, hint: str
) -> None:
    with pytest.raises(MotionError, match=hint):
        read_motion(tmp_path / f"motion{suffix}", body)


def test_a_suffix_in_capitals_and_letters_of_any_script_are_taken(body: Body, tmp_path: Path) -> None:
    path = write_npz(tmp_path / "m.npz", amass()).rename(tmp_path / "Größe und 動き.NPZ")
    assert read_motion(path, body).name == "Größe und 動き"


def test_resampling_to_a_rate_that_means_the_same_changes_no_frame() -> None:
    motion = random_motion(9, fps=30000 / 1001)
    same = resample(motion, 29.97)
    assert same.fps == 29.97
    assert torch.equal(same.rotations, motion.rotations)
    assert len(resample(random_motion(9, fps=24.0), 24000 / 1001)) == 8


def test_missing_foreign_and_truncated_files_are_refused(body: Body, tmp_path: Path) -> None:
    with pytest.raises(MotionError, match="no such file"):
        read_motion(tmp_path / "none.npz", body)
    with pytest.raises(MotionError, match=r"found '\.fbx'"):
        read_motion(tmp_path / "none.fbx", body)
    clip = bytearray((EMBEDDED_MOTIONS / "cmu_01_01.npz").read_bytes())
    (tmp_path / "cut.npz").write_bytes(clip[:5000])
    clip[2000:2100] = bytes(100)
    (tmp_path / "damaged.npz").write_bytes(clip)
    for name in ("cut.npz", "damaged.npz"):
        with pytest.raises(MotionError, match="cannot be read"):
            read_motion(tmp_path / name, body)


def test_resampling_to_an_integer_fraction_picks_the_same_frames() -> None:
    motion = random_motion(13, fps=120.0)
    slower = resample(motion, 30.0)
    assert (len(slower), slower.fps) == (4, 30.0)
    turns = [matrix_from_axis_angle(r) for r in (slower.rotations, motion.rotations[::4])]
    assert torch.allclose(turns[0], turns[1], atol=1e-6)
    assert torch.allclose(slower.translations, motion.translations[::4], atol=1e-6)


def test_resampling_up_and_down_again_gives_the_motion_back() -> None:
    motion = random_motion(9)
    back = resample(resample(motion, 90.0), 30.0)
    turns = [matrix_from_axis_angle(m.rotations) for m in (motion, back)]
    assert torch.allclose(turns[0], turns[1], atol=1e-5)


def test_resampling_a_steady_spin_stays_a_steady_spin_through_half_turns() -> None:
    angles = torch.arange(10) * 0.8
    rotations = torch.zeros(10, len(JOINT_NAMES), 3)
    rotations[:, 0, 1] = angles
    motion = Motion(rotations, torch.outer(angles, torch.tensor([1.0, 0.0, 2.0])), 10.0)
    finer = resample(motion, 25.0)
    expected = torch.zeros(len(finer), 3)
    expected[:, 1] = torch.arange(len(finer)) * 0.8 * 10 / 25
    turns = matrix_from_axis_angle(finer.rotations[:, 0])
    assert torch.allclose(turns, matrix_from_axis_angle(expected), atol=1e-5)
    assert torch.allclose(finer.translations[:, 2], 2 * expected[:, 1], atol=1e-5)


def test_resampling_one_frame_keeps_it_and_a_rate_of_zero_is_refused() -> None:
    motion = random_motion(1)
    assert torch.allclose(resample(motion, 60.0).translations, motion.translations)
    with pytest.raises(MotionError, match="cannot be resampled to 0"):
        resample(motion, 0.0)


@pytest.mark.parametrize(("name", "frames"), [("cmu_01_01", 688), ("cmu_01_03", 1128)])
def test_embedded_clips_stand_upright_on_the_ground(body: Body, name: str, frames: int) -> None:
    motion = read_motion(EMBEDDED_MOTIONS / f"{name}.npz", body)
    assert (len(motion), motion.fps) == (frames, 30.0)
    first = pose_vertices(body, motion[0])
    assert abs(first[:, 1].min().item()) < 0.02
    assert 1.4 < first[:, 1].max().item() < 1.75
    # 1/30 s at 5 m/s, faster than anything these people do with their hips.
    assert motion.translations.diff(dim=0).norm(dim=1).max() < 0.17
