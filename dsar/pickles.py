"""Pickles of plain data and arrays, read without running what they say.

Published body models and captures are pickles, and a pickle is a program. This reader builds numbers,
strings, containers and arrays, those of chumpy and SciPy in old files included, and refuses the rest.
"""

import pickle
import warnings
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

# What `pickle`, by its manual, raises on a damaged file.
PICKLE_ERRORS = (
    OSError,
    ValueError,
    EOFError,
    pickle.UnpicklingError,
    AttributeError,
    ImportError,
    LookupError,
    TypeError,
    MemoryError,
    OverflowError,
)
"""What `read_pickle` raises on a file that is damaged or holds anything but data."""


def read_pickle(path: Path) -> Any:
    """Return what a pickle holds.

    Raises:
        PICKLE_ERRORS: the file is damaged, or refers to code.
    """
    with path.open("rb") as file, warnings.catch_warnings():
        # Files written by Python 2 spell the dtype's `align` as 0 or 1.
        warnings.filterwarnings("ignore", r"dtype\(\): align", np.exceptions.VisibleDeprecationWarning)
        return _DataUnpickler(file).load()


class _DataUnpickler(pickle.Unpickler):
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
        raise pickle.UnpicklingError(f"it refers to {module}.{name}, which is not data")


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
