"""PLY files of any writer: read, or refused by what they are."""

from collections.abc import Callable

import numpy as np
import plyfile
import pytest
import torch
from splat_files import NAMES, retyped, save

from dsar.errors import ExportError
from dsar_exporters import find_faults, read_splats


def test_a_header_of_windows_with_letters_of_all_alphabets_is_read(cloud, tmp_path):
    written = save(tmp_path / "a.ply", cloud).read_bytes()
    end = written.index(b"end_header") + len("end_header\n")
    header = written[:end].replace(b"element", "comment Größe 人\nelement".encode()).replace(b"\n", b"\r\n")
    other = tmp_path / "Größe 人.ply"
    other.write_bytes(header + written[end:])
    assert find_faults(other) == []
    torch.testing.assert_close(read_splats(other).means, read_splats(tmp_path / "a.ply").means)


def _only(*names: str) -> Callable[[np.ndarray], np.ndarray]:
    return lambda vertices: np.ascontiguousarray(retyped(vertices[list(names)], lambda name: "<f4"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_only("x", "y", "z"), "found a point cloud, which has no properties f_dc_0, .*rot_3$"),
        (_only(*NAMES[:9], *NAMES[10:]), r"found 2D Gaussians \(.*\), which have no properties scale_2$"),
        (_only(*NAMES[:6], *NAMES[7:]), "found a file with no properties opacity$"),
        (
            lambda vertices: retyped(vertices, lambda name: "u1" if name == "opacity" else "<f4"),
            "expected a float or double in opacity, found uint8",
        ),
    ],
    ids=["points", "2DGS", "lacking", "bytes"],
)
def test_a_ply_of_something_else_is_called_what_it_is(cloud, tmp_path, change, message):
    with pytest.raises(ExportError, match=message):
        find_faults(save(tmp_path / "a.ply", change(cloud)))


def test_a_mesh_is_called_a_mesh(cloud, tmp_path):
    faces = np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))])
    elements = [plyfile.PlyElement.describe(_only("x", "y", "z")(cloud), "vertex")]
    elements.append(plyfile.PlyElement.describe(faces, "face"))
    plyfile.PlyData(elements).write(tmp_path / "a.ply")
    with pytest.raises(ExportError, match="found a mesh, which has no properties"):
        read_splats(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda content: content[:-1000],
            "broken or cut short: element 'vertex': row 382.* early end-of-file",
        ),
        (lambda content: content[:100], "no end of its header: it was cut short"),
        (lambda content: content.replace(b"vertex 400", b"vertex 99999999999999"), "counts more than it can"),
        (lambda content: content.replace(b"vertex 400", b"vertex -4"), "broken or cut short: "),
        (lambda content: b"\x00\x05\x16\x07" + content, "what macOS notes about the file"),
        (lambda content: b"nonsense", "found one that starts with b'nons'"),
        (lambda content: b"", "found an empty file"),
    ],
    ids=["body", "header", "count", "negative", "macOS", "foreign", "empty"],
)
def test_a_broken_ply_is_one_true_line(cloud, tmp_path, change, message):
    path = save(tmp_path / "a.ply", cloud)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(ExportError, match=message) as refused:
        find_faults(path)
    assert "\n" not in str(refused.value)
