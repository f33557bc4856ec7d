"""Body-model files in SMPL-X's format: the embedded CC0 body, or a licensed SMPL-X or SMPL-H file.

Nothing in a file is executed: .npz is read without pickle, .pkl by `dsar.pickles`.
"""

import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dsar.body.model import FACE_JOINTS, HEAD, JOINT_NAMES, PARENTS
from dsar.errors import BodyError
from dsar.pickles import PICKLE_ERRORS, read_pickle
from dsar.types import Body

EMBEDDED_BODY = Path(__file__).parent / "data" / "body.npz"
"""The body that comes with the package: an adult woman made from MakeHuman's CC0 data."""

_REQUIRED = ("v_template", "shapedirs", "weights", "kintree_table", "f")
_UV_KEYS = ("vt", "ft")
_HAND_KEYS = (("hands_componentsl", "hands_componentsr"), ("hands_meanl", "hands_meanr"))
_OPTIONAL = ("J_regressor", "j_template", "j_shapedirs")
# What NumPy raises on a damaged .npz.
_DAMAGE_ERRORS = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error)
_DIRECTIONS = {"shapedirs", "j_shapedirs"}
# Columns of `shapedirs` in the published SMPL-X files, of which the rest are expressions.
_SHAPES_OF_COLUMNS = {20: 10, 400: 300}

_SMPLH_PARENTS = tuple(
    parent - len(FACE_JOINTS) if parent > FACE_JOINTS[-1] else parent
    for joint, parent in enumerate(PARENTS)
    if joint not in FACE_JOINTS
)


def load_body(path: Path | None = None, betas: Float[Tensor, " s"] | None = None) -> Body:
    """Return a body of a given shape in the rest T-pose, float32.

    Args:
        path: an SMPL-X or SMPL-H .npz or .pkl file; None is the embedded body. SMPL-H joints are put
            in SMPL-X's order, with weightless jaw and eyes at the head.
        betas: shape coefficients in the file's units; fewer than the file has mean zeros for the rest.

    Raises:
        BodyError: the file is missing, unreadable or not such a body, or `betas` do not fit it.
    """
    path = EMBEDDED_BODY if path is None else Path(path)
    raw = _read_arrays(path)
    shape = _shape_vector(path, raw["shapedirs"], betas)
    for key in _DIRECTIONS & raw.keys():
        raw[key] = raw[key][..., : len(shape)]
    arrays = {key: _as_numbers(path, key, value) for key, value in raw.items()}
    _check_shapes(path, arrays)
    vertices = arrays["v_template"] + arrays["shapedirs"] @ shape
    if "j_template" in arrays and "j_shapedirs" in arrays:
        joints = arrays["j_template"] + arrays["j_shapedirs"] @ shape
    else:
        joints = arrays["J_regressor"] @ vertices
    weights = arrays["weights"]
    if len(joints) != len(JOINT_NAMES):
        joints, weights = _insert_face_joints(joints, weights)
    return Body(
        vertices=_as_float(vertices),
        faces=_as_index(arrays["f"]),
        joints=_as_float(joints),
        parents=PARENTS,
        weights=_as_float(weights / weights.sum(1, keepdims=True)),
        uv=_as_float(arrays["vt"]),
        uv_faces=_as_index(arrays["ft"]),
    )


def choose_body(path: Path | None, gender: str) -> Path | None:
    """Return the body-model file that a user chose, by argument or in $DSAR_BODY; None if they did not.

    Args:
        path: A file, or a folder with SMPLX_<GENDER>.npz or .pkl.
        gender: `neutral`, `female` or `male`: which of a folder's files.

    Raises:
        BodyError: the folder has no such file, or $DSAR_BODY names nothing.
    """
    named = os.environ.get("DSAR_BODY", "").strip()
    chosen = path or (Path(named) if named else None)
    # Shells leave the ~ of --body=~/x and of variables as it is.
    chosen = chosen and chosen.expanduser()
    if chosen and not path and not chosen.exists():
        raise BodyError(f"$DSAR_BODY is {named!r}: no such file or folder; correct it, or give --body")
    if chosen is None or not chosen.is_dir():
        return chosen
    names = [f"SMPLX_{gender.upper()}{suffix}" for suffix in (".npz", ".pkl")]
    found = next((chosen / name for name in names if (chosen / name).is_file()), None)
    if found is None:
        raise BodyError(f"body folder {chosen}: has neither {' nor '.join(names)}; give the file itself")
    return found


def load_hands(path: Path) -> tuple[Float[Tensor, "2 k 45"], Float[Tensor, "2 45"]]:
    """Return the principal components of the hands' poses and the mean poses: left, then right; radians.

    Raises:
        BodyError: the file has none.
    """
    found = _read_arrays(path, tuple(key for keys in _HAND_KEYS for key in keys))
    missing = [key for keys in _HAND_KEYS for key in keys if key not in found]
    if missing:
        raise BodyError(
            f"body file {path}: lacks {', '.join(missing)}, without which hands given as principal "
            "components mean nothing; use SMPL-X's own file"
        )
    components, means = (
        torch.stack([_as_float(_as_numbers(path, key, found[key])) for key in keys]) for keys in _HAND_KEYS
    )
    if components.shape[-1] != 45 or means.shape != (2, 45):
        raise BodyError(f"body file {path}: hands have shapes {tuple(components.shape)}, expected (2, k, 45)")
    return components, means


def _read_arrays(path: Path, also: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    """Return the arrays of a body file that we use; the rest is not opened."""
    kind = path.suffix.lower()
    if kind not in (".npz", ".pkl"):
        raise BodyError(f"body file {path}: expected a .npz or .pkl file, found suffix {path.suffix!r}")
    if not path.is_file():
        raise BodyError(f"body file {path}: no such file; give the path of an SMPL-X .npz or .pkl file")
    try:
        found = _read_npz(path, also) if kind == ".npz" else _read_pickle(path, also)
    except (*_DAMAGE_ERRORS, *PICKLE_ERRORS) as error:
        raise BodyError(
            f"body file {path}: cannot be read ({error}); expected a whole .npz or .pkl file"
        ) from error
    missing = [key for key in _REQUIRED if key not in found]
    if not ("J_regressor" in found or {"j_template", "j_shapedirs"} <= found.keys()):
        missing.append("J_regressor")
    if missing:
        raise BodyError(
            f"body file {path}: lacks {', '.join(missing)}; expected a body model in SMPL-X's format"
        )
    if not all(key in found for key in _UV_KEYS):
        raise BodyError(
            f"body file {path}: has no texture coordinates (vt, ft), which place the garment's texels; "
            "use SMPL-X v1.1 (SMPLX_*.npz), or add vt (u, 2) and ft (t, 3) from the model's UV .obj"
        )
    return found


def _read_npz(path: Path, also: tuple[str, ...]) -> dict[str, np.ndarray]:
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        return {key: file[key] for key in (*_REQUIRED, *_UV_KEYS, *_OPTIONAL, *also) if key in file.files}


def _read_pickle(path: Path, also: tuple[str, ...]) -> dict[str, np.ndarray]:
    content = read_pickle(path)
    if not isinstance(content, Mapping):
        raise ValueError(f"holds a {type(content).__name__}, not a dictionary")
    return {
        key: np.asarray(content[key]) for key in (*_REQUIRED, *_UV_KEYS, *_OPTIONAL, *also) if key in content
    }


def _as_numbers(path: Path, key: str, array: np.ndarray) -> np.ndarray:
    """Return integers as int64 and finite reals as float64, or raise."""
    if array.dtype.kind not in "fiu":
        raise BodyError(f"body file {path}: {key} holds {array.dtype}, expected numbers")
    if array.ndim == 0 or len(array) == 0:
        raise BodyError(f"body file {path}: {key} has shape {array.shape}, expected a filled array")
    if array.dtype.kind != "f":
        return array.astype(np.int64)
    if not np.isfinite(array).all():
        raise BodyError(
            f"body file {path}: {key} holds values that are not finite; expected a file as it was published"
        )
    return array.astype(np.float64)


def _check_shapes(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise unless the arrays describe one skinned mesh with SMPL-X's or SMPL-H's skeleton."""
    vertices, joints = len(arrays["v_template"]), arrays["kintree_table"].shape[-1]
    expected = {
        "v_template": (vertices, 3),
        "weights": (vertices, joints),
        "kintree_table": (2, joints),
        "f": (len(arrays["f"]), 3),
        "ft": (len(arrays["f"]), 3),
        "vt": (len(arrays["vt"]), 2),
        "shapedirs": (vertices, 3, arrays["shapedirs"].shape[-1]),
        "J_regressor": (joints, vertices),
        "j_template": (joints, 3),
        "j_shapedirs": (joints, 3, arrays["shapedirs"].shape[-1]),
    }
    for key, array in arrays.items():
        if array.shape != expected[key]:
            raise BodyError(f"body file {path}: {key} has shape {array.shape}, expected {expected[key]}")
    for key, limit in (("f", vertices), ("ft", len(arrays["vt"]))):
        if arrays[key].min() < 0 or arrays[key].max() >= limit:
            raise BodyError(f"body file {path}: {key} refers to entries outside 0..{limit - 1}")
    unbound = int((arrays["weights"].sum(1) <= 0).sum())
    if unbound:
        raise BodyError(
            f"body file {path}: {unbound} vertices have no skinning weight; expected rows that sum to 1"
        )
    parents = tuple(arrays["kintree_table"][0, 1:].tolist())
    if parents not in (PARENTS[1:], _SMPLH_PARENTS[1:]):
        raise BodyError(
            f"body file {path}: its {joints} joints are not the skeleton of SMPL-X (55) or SMPL-H (52); "
            "use one of those models"
        )


def _insert_face_joints(
    joints: Float[np.ndarray, "k 3"], weights: Float[np.ndarray, "v k"]
) -> tuple[Float[np.ndarray, "j 3"], Float[np.ndarray, "v j"]]:
    """Return SMPL-H joints and weights in SMPL-X's order: jaw and eyes at the head, moving nothing."""
    where = [FACE_JOINTS[0]] * len(FACE_JOINTS)
    return np.insert(joints, where, joints[HEAD], axis=0), np.insert(weights, where, 0.0, axis=1)


def _shape_vector(path: Path, directions: np.ndarray, betas: Tensor | None) -> Float[np.ndarray, " s"]:
    """Return the betas as float64; more than the file has directions for would do nothing, so they raise."""
    if betas is None:
        return np.zeros(0)
    shape = betas.detach().cpu().double().numpy()
    columns: int = directions.shape[-1]
    used = np.flatnonzero(directions[..., : _SHAPES_OF_COLUMNS.get(columns, columns)].any(axis=(0, 1)))
    limit = used[-1] + 1 if len(used) else 0
    if len(shape) > limit:
        raise BodyError(f"body file {path}: {len(shape)} betas given, the file has {limit}; drop the rest")
    if not np.isfinite(shape).all():
        raise BodyError(f"body file {path}: the betas hold values that are not finite")
    return shape


def _as_float(array: np.ndarray) -> Float[Tensor, "..."]:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))


def _as_index(array: np.ndarray) -> Int[Tensor, "..."]:
    return torch.from_numpy(np.ascontiguousarray(array, np.int64))
