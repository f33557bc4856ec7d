"""Motion files: what is written is read back, Z-up files land Y-up, broken ones are refused."""

from pathlib import Path

import numpy as np
import pytest
import torch

from dsar.body.files import load_body
from dsar.body.model import FACE_JOINTS, JOINT_NAMES
from dsar.body.skinning import pose_vertices
from dsar.data.motion import EMBEDDED_MOTIONS, read_motion, resample, write_motion
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
    motion = read_motion(write_npz(tmp_path / "m.npz", arrays), body)
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
