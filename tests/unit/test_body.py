"""Body files: the embedded one says what SMPL-X's format promises; broken ones are refused by name."""

import pickle
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from scipy.sparse import csc_matrix

from dsar.body.files import EMBEDDED_BODY, load_body
from dsar.body.model import FACE_JOINTS, HEAD, JOINT_NAMES, PARENTS
from dsar.errors import BodyError

KEYS = ("v_template", "shapedirs", "weights", "kintree_table", "f", "vt", "ft", "J_regressor")


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    with np.load(EMBEDDED_BODY) as file:
        arrays = {key: file[key] for key in (*KEYS, "j_template", "j_shapedirs", "part", "part_names")}
    # The other columns are the room that readers expect for SMPL-X's expressions.
    assert not arrays["shapedirs"][:, :, 10:].any()
    return arrays | {"shapedirs": arrays["shapedirs"][:, :, :10]}


def write_npz(path: Path, arrays: dict[str, np.ndarray], **changes: np.ndarray | None) -> Path:
    values = {key: value for key, value in ({**arrays, **changes}).items() if value is not None}
    np.savez(path, allow_pickle=False, **values)
    return path


def test_embedded_body_is_a_standing_adult_facing_z_with_the_left_hand_at_x() -> None:
    body = load_body()
    height = body.vertices[:, 1].max() - body.vertices[:, 1].min()
    assert height.item() == pytest.approx(1.68, abs=0.01)
    joint = {name: body.joints[i] for i, name in enumerate(JOINT_NAMES)}
    assert joint["left_wrist"][0] > 0.5
    assert joint["right_wrist"][0] < -0.5
    assert joint["left_foot"][2] > joint["left_ankle"][2] + 0.1
    assert joint["head"][1] > joint["pelvis"][1] + 0.5 > joint["left_ankle"][1] + 1.0


def test_faces_look_outwards_so_the_volume_is_that_of_a_person() -> None:
    body = load_body()
    corners = body.vertices[body.faces].double()
    volume = torch.linalg.det(corners).sum() / 6
    assert 0.045 < volume.item() < 0.075


def test_every_face_has_area_and_every_vertex_and_coordinate_is_used() -> None:
    body = load_body()
    assert body.faces.unique().tolist() == list(range(len(body.vertices)))
    assert body.uv_faces.unique().tolist() == list(range(len(body.uv)))
    assert bool(((body.uv >= 0) & (body.uv <= 1)).all())


def test_weights_are_convex_and_face_joints_have_none() -> None:
    body = load_body()
    assert torch.allclose(body.weights.sum(1), torch.ones(len(body.vertices)), atol=1e-6)
    assert body.weights.min() >= 0
    assert body.weights[:, FACE_JOINTS.start : FACE_JOINTS.stop].abs().max() == 0
    without_weight = [name for name, w in zip(JOINT_NAMES, body.weights.T, strict=True) if w.max() == 0]
    assert without_weight == list(JOINT_NAMES[FACE_JOINTS.start : FACE_JOINTS.stop])


def test_every_part_label_is_known_and_used_about_equally_on_both_sides(
    arrays: dict[str, np.ndarray],
) -> None:
    names = arrays["part_names"].tolist()
    assert names == ["skin", "lips", "nails", "scalp", "eye", "iris"]
    left = arrays["v_template"][:, 0] > 0
    for part in range(len(names)):
        share = left[arrays["part"] == part].mean()
        assert share == pytest.approx(0.5, abs=0.05), names[part]


def test_betas_move_joints_and_vertices_by_the_files_directions(arrays: dict[str, np.ndarray]) -> None:
    betas = torch.tensor([1.5, -2.0, 0.5])
    rest, shaped = load_body(), load_body(betas=betas)
    joints = torch.from_numpy(arrays["j_shapedirs"][:, :, :3]) @ betas
    vertices = torch.from_numpy(arrays["shapedirs"][:, :, :3]) @ betas
    assert torch.allclose(shaped.joints - rest.joints, joints, atol=1e-6)
    assert torch.allclose(shaped.vertices - rest.vertices, vertices, atol=1e-6)


def test_joint_regressor_repeats_the_exact_joints_at_every_shape(
    arrays: dict[str, np.ndarray], tmp_path: Path
) -> None:
    path = write_npz(tmp_path / "body.npz", arrays, j_template=None, j_shapedirs=None)
    betas = torch.linspace(-3, 3, 10)
    regressed, exact = load_body(path, betas), load_body(betas=betas)
    # float32 coefficients over a metre, times ten betas of up to three.
    assert (regressed.joints - exact.joints).abs().max() < 1e-5


def test_smplh_file_gets_weightless_face_joints_at_the_head(
    arrays: dict[str, np.ndarray], tmp_path: Path
) -> None:
    kept = [j for j in range(len(JOINT_NAMES)) if j not in FACE_JOINTS]
    parents = np.array([kept.index(PARENTS[j]) if j else 2**32 - 1 for j in kept], np.uint32)
    path = write_npz(
        tmp_path / "smplh.npz",
        arrays,
        weights=arrays["weights"][:, kept],
        kintree_table=np.stack([parents, np.arange(len(kept), dtype=np.uint32)]),
        J_regressor=arrays["J_regressor"][kept],
        j_template=None,
        j_shapedirs=None,
    )
    smplh, smplx = load_body(path), load_body()
    assert smplh.parents == PARENTS
    assert torch.equal(smplh.weights, smplx.weights)
    assert torch.allclose(smplh.joints[kept], smplx.joints[kept], atol=1e-5)
    assert torch.equal(smplh.joints[list(FACE_JOINTS)], smplh.joints[[HEAD] * 3])


@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_pickle_with_sparse_and_chumpy_arrays_gives_the_same_body(
    arrays: dict[str, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: int
) -> None:
    class Ch:
        def __init__(self, x: np.ndarray) -> None:
            self.x = x

    chumpy = ModuleType("chumpy")
    Ch.__module__, Ch.__qualname__, chumpy.Ch = "chumpy", "Ch", Ch  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "chumpy", chumpy)
    content = {key: arrays[key] for key in KEYS} | {
        "v_template": Ch(arrays["v_template"]),
        "J_regressor": csc_matrix(arrays["J_regressor"]),
    }
    path = tmp_path / "body.pkl"
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    monkeypatch.delitem(sys.modules, "chumpy")
    loaded, embedded = load_body(path), load_body()
    assert torch.equal(loaded.vertices, embedded.vertices)
    assert torch.allclose(loaded.joints, embedded.joints, atol=1e-5)


def test_pickle_that_would_run_code_is_refused_before_it_runs(tmp_path: Path) -> None:
    path = tmp_path / "body.pkl"
    path.write_bytes(b"cos\nsystem\n(S'touch " + str(tmp_path / "ran").encode() + b"'\ntR.")
    with pytest.raises(BodyError, match=r"os\.system"):
        load_body(path)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": None}, "lacks weights"),
        ({"J_regressor": None, "j_template": None}, "lacks J_regressor"),
        ({"vt": None}, "no texture coordinates"),
        ({"v_template": np.zeros((5, 3))}, "expected"),
        ({"v_template": np.array(1.0)}, "filled array"),
        ({"vt": np.full((13503, 2), np.nan)}, "not finite"),
        ({"vt": np.zeros((7, 2))}, r"ft refers to entries outside 0\.\.6"),
        ({"kintree_table": np.zeros((2, 55), int)}, "not the skeleton of SMPL-X"),
        ({"f": np.array([["a"]])}, "expected numbers"),
    ],
)
def test_broken_file_is_refused_with_its_name_and_fault(
    arrays: dict[str, np.ndarray], tmp_path: Path, changes: dict[str, np.ndarray | None], message: str
) -> None:
    path = write_npz(tmp_path / "broken.npz", arrays, **changes)
    with pytest.raises(BodyError, match=message) as error:
        load_body(path)
    assert str(path) in str(error.value)


def test_missing_foreign_and_truncated_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BodyError, match="no such file"):
        load_body(tmp_path / "none.npz")
    with pytest.raises(BodyError, match="suffix"):
        load_body(tmp_path / "body.obj")
    for name in ("cut.npz", "cut.pkl"):
        (tmp_path / name).write_bytes(EMBEDDED_BODY.read_bytes()[:1000])
        with pytest.raises(BodyError, match="cannot be read"):
            load_body(tmp_path / name)


def test_betas_that_do_not_fit_are_refused() -> None:
    with pytest.raises(BodyError, match="11 betas given, the file has 10"):
        load_body(betas=torch.zeros(11))
    with pytest.raises(BodyError, match="not finite"):
        load_body(betas=torch.tensor([float("nan")]))
