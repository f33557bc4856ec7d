"""Body-model files in SMPL-X's format: the embedded CC0 body, or a licensed SMPL-X or SMPL-H file.

Nothing in a file is executed: .npz is read without pickle, .pkl through an unpickler that builds
arrays and nothing else.
"""

import pickle
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dsar.body.model import FACE_JOINTS, HEAD, JOINT_NAMES, PARENTS, Body
from dsar.errors import BodyError

EMBEDDED_BODY = Path(__file__).parent / "data" / "body.npz"
"""The body that comes with the package: an adult woman made from MakeHuman's CC0 data."""

_REQUIRED = ("v_template", "shapedirs", "weights", "kintree_table", "f")
_UV_KEYS = ("vt", "ft")
_OPTIONAL = ("J_regressor", "j_template", "j_shapedirs")
# What NumPy raises on a damaged .npz, and `pickle`, by its manual, on a damaged .pkl.
_DAMAGE_ERRORS = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error)
_PICKLE_ERRORS = (pickle.UnpicklingError, AttributeError, ImportError, LookupError, TypeError)
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


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a body file that we use; the rest is not opened."""
    if path.suffix not in (".npz", ".pkl"):
        raise BodyError(f"body file {path}: expected a .npz or .pkl file, found suffix {path.suffix!r}")
    if not path.is_file():
        raise BodyError(f"body file {path}: no such file; give the path of an SMPL-X .npz or .pkl file")
    try:
        found = _read_npz(path) if path.suffix == ".npz" else _read_pickle(path)
    except (*_DAMAGE_ERRORS, *_PICKLE_ERRORS) as error:
        raise BodyError(f"body file {path}: cannot be read ({error}); download it again") from error
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


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        return {key: file[key] for key in (*_REQUIRED, *_UV_KEYS, *_OPTIONAL) if key in file.files}


def _read_pickle(path: Path) -> dict[str, np.ndarray]:
    with path.open("rb") as file, warnings.catch_warnings():
        # Files written by Python 2 spell the dtype's `align` as 0 or 1.
        warnings.filterwarnings("ignore", r"dtype\(\): align", np.exceptions.VisibleDeprecationWarning)
        content = _ArrayUnpickler(file).load()
    if not isinstance(content, Mapping):
        raise ValueError(f"holds a {type(content).__name__}, not a dictionary")
    return {key: np.asarray(content[key]) for key in (*_REQUIRED, *_UV_KEYS, *_OPTIONAL) if key in content}


class _ArrayUnpickler(pickle.Unpickler):
    """Unpickles arrays, those of chumpy and SciPy in published files included, and refuses the rest."""

    _ALLOWED = frozenset(
        {
            *(("numpy", name) for name in ("ndarray", "dtype")),
            *((f"numpy.{c}.multiarray", n) for c in ("core", "_core") for n in ("_reconstruct", "scalar")),
            *((f"numpy.{c}.numeric", "_frombuffer") for c in ("core", "_core")),
            ("_codecs", "encode"),
            ("collections", "OrderedDict"),
            *((module, "object") for module in ("builtins", "__builtin__")),
            *((module, "_reconstructor") for module in ("copyreg", "copy_reg")),
        }
    )

    def __init__(self, file: BinaryIO) -> None:
        # The published files were written by Python 2, whose strings are bytes.
        super().__init__(file, encoding="latin1")

    def find_class(self, module: str, name: str) -> Any:
        """Return the class of a name in the file, or a stand-in that only holds state."""
        if module.split(".")[0] == "chumpy" or (module.startswith("scipy.sparse") and name == "csc_matrix"):
            return _StateHolder
        if (module, name) in self._ALLOWED:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"it refers to {module}.{name}, which no body model needs")


class _StateHolder:
    """Stands for a chumpy array or a SciPy CSC matrix without running their code."""

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Return the held values as a dense array."""
        state = vars(self)
        if "indptr" in state:
            rows, count = state["_shape"]
            dense = np.zeros((rows, count))
            columns = np.repeat(np.arange(count), np.diff(state["indptr"]))
            dense[state["indices"], columns] = state["data"]
            return dense.astype(dtype or dense.dtype)
        if "x" in state:
            return np.asarray(state["x"], dtype=dtype)
        if {"a", "idxs", "preferred_shape"} <= state.keys():
            source = np.asarray(state["a"], dtype=dtype).reshape(-1)
            return source[np.asarray(state["idxs"])].reshape(state["preferred_shape"])
        raise ValueError(f"an array stored as {sorted(state)} is not understood")


def _as_numbers(path: Path, key: str, array: np.ndarray) -> np.ndarray:
    """Return integers as int64 and finite reals as float64, or raise."""
    if array.dtype.kind not in "fiu":
        raise BodyError(f"body file {path}: {key} holds {array.dtype}, expected numbers")
    if array.ndim == 0 or len(array) == 0:
        raise BodyError(f"body file {path}: {key} has shape {array.shape}, expected a filled array")
    if array.dtype.kind != "f":
        return array.astype(np.int64)
    if not np.isfinite(array).all():
        raise BodyError(f"body file {path}: {key} holds values that are not finite; download it again")
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
