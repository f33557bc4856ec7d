"""GLB files with KHR_gaussian_splatting: faults told, others refused."""

import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest

from dsar.errors import ExportError
from dsar_exporters import find_faults

SPLATTING = "KHR_gaussian_splatting"


def _spoil_glb(path: Path, semantic: str, value: float) -> None:
    """Write a number over the first of an attribute, in the second chunk of a GLB."""
    content = bytearray(path.read_bytes())
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    accessor = document["meshes"][0]["primitives"][0]["attributes"][semantic]
    view = document["bufferViews"][document["accessors"][accessor]["bufferView"]]
    struct.pack_into("<f", content, 28 + length + view.get("byteOffset", 0), value)
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("semantic", "value", "message"),
    [
        ("POSITION", np.nan, "expected finite POSITION, found . NaN among 1800 values"),
        (f"{SPLATTING}:SCALE", np.inf, "expected finite SCALE, found 1 inf among 1800 values"),
        (f"{SPLATTING}:OPACITY", np.nan, "expected finite OPACITY, found 1 NaN among 600 values"),
        (f"{SPLATTING}:SCALE", 500.0, "expected Gaussians smaller than their cloud .* up to 500"),
        (f"{SPLATTING}:SCALE", -1.0, "negative KHR_gaussian_splatting:SCALE value"),
        (f"{SPLATTING}:OPACITY", 2.2, "OPACITY value outside"),
    ],
)
def test_a_faulty_glb_is_told(written, semantic, value, message):
    assert find_faults(written["glb"]) == []
    _spoil_glb(written["glb"], semantic, value)
    try:
        (fault,) = find_faults(written["glb"])
    except ExportError as error:
        fault = str(error)
    assert re.search(message, fault)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "found an empty file"),
        (b"nonsense", "found one that starts with b'nons'"),
        (b"glTF" + struct.pack("<II", 2, 999), "a faulty one: GLB header declares 999 bytes"),
        (b"glTF" + struct.pack("<II", 2, 12), "a faulty one: the GLB holds no JSON chunk"),
    ],
)
def test_what_is_no_glb_of_splats_is_refused(tmp_path, content, message):
    (tmp_path / "a.glb").write_bytes(content)
    with pytest.raises(ExportError, match=message):
        find_faults(tmp_path / "a.glb")
