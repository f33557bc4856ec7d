"""Pickles of data are read; those that are programs are not run."""

import collections
import os
import pickle
import subprocess

import numpy as np
import pytest

from dsar.pickles import PICKLE_ERRORS, read_pickle


class Program:
    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_plain_data_and_arrays_come_back(tmp_path, protocol):
    content = {
        "numbers": [1, 2.5, None, True, (3, 4)],
        "array": np.arange(6, dtype=np.float32).reshape(2, 3)[:, ::-1],
        "scalar": np.float64(1.5),
        "text": np.array(["a", "bc"]),
        "ordered": collections.OrderedDict(a=1),
    }
    (tmp_path / "p.pkl").write_bytes(pickle.dumps(content, protocol))
    found = read_pickle(tmp_path / "p.pkl")
    for key in ("array", "text"):
        assert np.array_equal(found.pop(key), content.pop(key))
    assert found == content


@pytest.mark.parametrize(
    "program",
    [
        Program(os.mkdir, "touched"),
        Program(subprocess.Popen, ["touch", "touched"]),
        Program(eval, "open('touched', 'w')"),
        Program(np.load, "x.npy", None, True),
        Program(getattr, "x", "join"),
    ],
    ids=["mkdir", "popen", "eval", "numpy", "getattr"],
)
def test_a_program_is_refused_and_not_run(tmp_path, monkeypatch, program):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.pkl").write_bytes(pickle.dumps({"array": np.zeros(3), "more": program}))
    with pytest.raises(PICKLE_ERRORS, match="which is not data"):
        read_pickle(tmp_path / "p.pkl")
    assert [path.name for path in tmp_path.iterdir()] == ["p.pkl"]
