"""Splat files of any writer: what is in them is read or refused by its true name, and raw faults are told."""

import gzip
import json
import re
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import gsply
import numpy as np
import plyfile
import pytest
import torch

from dsar.errors import ExportError, MissingDependencyError
from dsar_exporters import CompressedPlySequence, GltfSnapshot, SpzSequence, export, find_faults, read_splats

NAMES = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
COUNT = 400
SPLATTING = "KHR_gaussian_splatting"


@pytest.fixture
def cloud() -> np.ndarray:
    """A sound cloud as an optimiser leaves it: a person's size, quaternions of any length."""
    random = np.random.default_rng(0)
    vertices = np.zeros(COUNT, [(name, "<f4") for name in NAMES])
    for name in NAMES:
        vertices[name] = random.normal(size=COUNT)
    for name in "xyz":
        vertices[name] *= 0.5
    vertices["opacity"] *= 3
    for name in ("scale_0", "scale_1", "scale_2"):
        vertices[name] = vertices[name] / 2 - 4.5
    return vertices


def save(path: Path, vertices: np.ndarray, **how) -> Path:
    plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")], **how).write(path)
    return path


def retyped(vertices: np.ndarray, types: Callable[[str], str]) -> np.ndarray:
    return vertices.astype([(name, types(name)) for name in vertices.dtype.names])


def logarithms_to_metres(vertices: np.ndarray) -> None:
    for name in ("scale_0", "scale_1", "scale_2"):
        vertices[name] = np.exp(vertices[name])


def to_millimetres(vertices: np.ndarray) -> None:
    for name in "xyz":
        vertices[name] *= 1000
    for name in ("scale_0", "scale_1", "scale_2"):
        vertices[name] += np.log(1000)


def logits_to_opacities(vertices: np.ndarray) -> None:
    vertices["opacity"] = 1 / (1 + np.exp(-vertices["opacity"]))


def colors_to_bytes(vertices: np.ndarray) -> None:
    for name in ("f_dc_0", "f_dc_1", "f_dc_2"):
        vertices[name] = np.random.default_rng(1).integers(0, 256, COUNT)


def set_to(name: str, value: float, count: int = 1) -> Callable[[np.ndarray], None]:
    def spoil(vertices: np.ndarray) -> None:
        vertices[name][:count] = value

    return spoil


def no_quaternions(vertices: np.ndarray) -> None:
    for name in ("rot_0", "rot_1", "rot_2", "rot_3"):
        vertices[name][:7] = 0


def all_at_one_place_half_in_metres(vertices: np.ndarray) -> None:
    for name in "xyz":
        vertices[name] = 0
    for name in ("scale_0", "scale_1", "scale_2"):
        vertices[name][: COUNT // 2] = 0.02


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (set_to("opacity", np.inf, 50), "expected finite opacity, found 50 inf among 400 values"),
        (set_to("opacity", -np.inf), "expected finite opacity, found 1 -inf among"),
        (set_to("scale_2", -np.inf, 50), "expected finite scale_2, found 50 -inf among 400 values"),
        (set_to("scale_0", np.inf), "expected finite scale_0, found 1 inf"),
        (set_to("x", np.nan, 2), "expected finite x, found 2 NaN"),
        (set_to("rot_3", np.nan), "expected finite rot_3, found 1 NaN"),
        (set_to("f_dc_1", np.inf), "expected finite f_dc_1, found 1 inf"),
        (logarithms_to_metres, "found 0.00.* which look like metres, not logarithms: all 400"),
        (all_at_one_place_half_in_metres, "found 200 of 400 .*up to 1.02: their scale_. look like metres"),
        (set_to("scale_1", 6.0), r"smaller than their cloud of [45]\.\d+, found 1 of 400 .* up to 403"),
        (set_to("scale_1", 1000.0), "found 1 of 400 with standard deviations up to inf"),
        (
            logits_to_opacities,
            "expected logits in opacity, found 400 values from 0.00.*, as if they were opacities",
        ),
        (colors_to_bytes, "expected harmonics in f_dc_.* are they bytes"),
        (set_to("f_dc_0", 1e6), r"expected colours near 0 to 1 from f_dc_\*, found 1 of 1200 beyond 100"),
        (no_quaternions, "expected quaternions in rot_., found 7 of 400 of length 0"),
    ],
)
def test_a_raw_fault_is_the_only_one_told(cloud, tmp_path, spoil, message):
    spoil(cloud)
    (fault,) = find_faults(save(tmp_path / "a.ply", cloud))
    assert re.search(message, fault), fault


@pytest.mark.parametrize(
    ("change", "how"),
    [
        (lambda vertices: None, {}),
        (lambda vertices: None, {"text": True}),
        (lambda vertices: None, {"byte_order": ">"}),
        (to_millimetres, {}),
        (set_to("opacity", 40.0), {}),
        (set_to("x", 300.0), {"comments": ["a floater"]}),
    ],
    ids=["plain", "text", "big-endian", "millimetres", "opaque", "floater"],
)
def test_what_is_sound_has_no_faults(cloud, tmp_path, change, how):
    change(cloud)
    assert find_faults(save(tmp_path / "a.ply", cloud, **how)) == []
    doubles = retyped(cloud, lambda name: "<f8")
    assert find_faults(save(tmp_path / "b.PLY", doubles, **how)) == []


def test_clouds_too_small_to_compare_are_not_judged_by_size(cloud, tmp_path):
    cloud["scale_0"] = 0.5
    assert find_faults(save(tmp_path / "a.ply", cloud[:3])) == []


def test_a_header_of_windows_with_letters_of_all_alphabets_is_read(cloud, tmp_path):
    written = save(tmp_path / "a.ply", cloud).read_bytes()
    end = written.index(b"end_header") + len("end_header\n")
    header = written[:end].replace(b"element", "comment Größe 人\nelement".encode()).replace(b"\n", b"\r\n")
    other = tmp_path / "Größe 人.ply"
    other.write_bytes(header + written[end:])
    assert find_faults(other) == []
    torch.testing.assert_close(read_splats(other).means, read_splats(tmp_path / "a.ply").means)


def test_bytes_after_the_last_gaussian_are_a_fault_and_nothing_is_one_too(cloud, tmp_path):
    path = save(tmp_path / "a.ply", cloud)
    path.write_bytes(path.read_bytes().replace(b"vertex 400", b"vertex 300"))
    assert find_faults(path) == [
        "expected the file to end after the 300 Gaussians of its header, found 5600 bytes more"
    ]
    assert find_faults(save(path, cloud[:0])) == ["expected Gaussians, found none"]


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


@pytest.fixture
def written(make_sequence, tmp_path) -> dict[str, Path]:
    """One frame of 600 Gaussians with harmonics of degree 1, in the small formats."""
    sequence = make_sequence(600, degree=1, frames=1)
    small = (CompressedPlySequence(tmp_path / "ply", "a"), SpzSequence(tmp_path / "spz", "a"))
    export(sequence, [*small, GltfSnapshot(tmp_path / "a.glb")])
    paths = {output.suffix.removeprefix("."): output.frame_path(1001) for output in small}
    return {**paths, "glb": tmp_path / "a.glb"}


def _elements(path: Path) -> dict[str, np.ndarray]:
    return {element.name: element.data for element in plyfile.PlyData.read(path, mmap=False).elements}


def _store(path: Path, elements: dict[str, np.ndarray]) -> Path:
    described = [plyfile.PlyElement.describe(records, name) for name, records in elements.items()]
    plyfile.PlyData(described).write(path)
    return path


def test_a_compressed_ply_is_unpacked_as_gsply_does_it(written):
    theirs, ours = gsply.plyread(written["compressed.ply"]), read_splats(written["compressed.ply"])
    assert _elements(written["compressed.ply"]).keys() == {"chunk", "vertex", "sh"}
    for found, expected in (
        (ours.means, theirs.means),
        (ours.scales, np.exp(theirs.scales)),
        (ours.rotations, theirs.quats / np.linalg.norm(theirs.quats, axis=1, keepdims=True)),
        (ours.opacities, 1 / (1 + np.exp(-theirs.opacities))),
        (ours.harmonics[:, 0], theirs.sh0),
        (ours.harmonics[:, 1:], theirs.shN),
    ):
        torch.testing.assert_close(found, torch.from_numpy(np.array(expected)), rtol=2e-6, atol=2e-6)


def test_a_compressed_ply_is_told_by_its_chunks_in_either_layout_and_under_any_name(written, tmp_path):
    new = _elements(written["compressed.ply"])
    chunks = new["chunk"]
    # Colours of the older layout have no bounds but 0 and 1.
    for side, bound in (("min", 0), ("max", 1)):
        for channel in "rgb":
            chunks[f"{side}_{channel}"] = bound
    renamed = _store(tmp_path / "renamed.PLY", new)
    names = [name for name in chunks.dtype.names if name[-1] not in "rgb"]
    assert len(names) == 12
    shorter = np.ascontiguousarray(retyped(chunks[names], lambda name: "<f4"))
    old = _store(tmp_path / "old.ply", {**new, "chunk": shorter})
    assert find_faults(renamed) == find_faults(old) == []
    for name, values in vars(read_splats(renamed)).items():
        assert torch.equal(getattr(read_splats(old), name), values), name


def test_a_plain_ply_under_a_compressed_ones_name_is_read(cloud, tmp_path):
    assert find_faults(save(tmp_path / "a.compressed.ply", cloud)) == []


def _bound(name: str, value: float) -> Callable[[dict[str, np.ndarray]], None]:
    def spoil(elements: dict[str, np.ndarray]) -> None:
        elements["chunk"][name][2] = value

    return spoil


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_bound("max_scale_x", np.inf), "finite min_scale_x and max_scale_x, found 1 of 3 chunks without"),
        (_bound("min_z", np.nan), "expected finite min_z and max_z, found 1 of 3"),
        (_bound("min_y", 99), "expected min_y below max_y, found 1 of 3 chunks the other way round"),
        (_bound("max_r", -99), "expected min_r below max_r"),
        (_bound("max_scale_z", 12), "expected Gaussians smaller than their cloud"),
    ],
)
def test_faulty_bounds_of_chunks_are_told(written, spoil, message):
    elements = _elements(written["compressed.ply"])
    spoil(elements)
    (fault,) = find_faults(_store(written["compressed.ply"], elements))
    assert message in fault


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: {**e, "chunk": e["chunk"][:2]}, "for each 256 of its 600 Gaussians, 3 chunks, found 2"),
        (lambda e: {"chunk": e["chunk"]}, "found no properties packed_position, .* in its element 'vertex'"),
        (
            lambda e: {"vertex": e["vertex"]},
            "a compressed PLY without its element 'chunk', so no properties x",
        ),
        (lambda e: {**e, "sh": e["sh"][:9]}, "harmonics of each of 600 Gaussians .* found 9 of 9"),
    ],
)
def test_elements_that_do_not_fit_are_refused(written, change, message):
    path = _store(written["compressed.ply"], change(_elements(written["compressed.ply"])))
    with pytest.raises(ExportError, match=message):
        find_faults(path)


def test_an_spz_is_read_or_refused_by_its_version(written):
    content = gzip.decompress(written["spz"].read_bytes())
    assert find_faults(written["spz"].rename(written["spz"].with_suffix(".SPZ"))) == []
    for version in (1, 5):
        written["spz"].write_bytes(gzip.compress(content[:4] + struct.pack("<I", version) + content[8:]))
        with pytest.raises(ExportError, match=f"SPZ of version 2, 3 or 4, found version {version}"):
            find_faults(written["spz"])


def test_an_spz_of_version_4_holds_what_its_version_3_does(written, tmp_path):
    pytest.importorskip("zstandard")
    gsply.write_spz(tmp_path / "4.spz", gsply.read_spz(written["spz"]), version=4)
    assert find_faults(tmp_path / "4.spz") == []
    torch.testing.assert_close(read_splats(tmp_path / "4.spz").means, read_splats(written["spz"]).means)
    cut = tmp_path / "cut.spz"
    cut.write_bytes((tmp_path / "4.spz").read_bytes()[:-50])
    with pytest.raises(ExportError, match="expected an SPZ file, found one that is broken"):
        find_faults(cut)


def test_without_zstandard_an_spz_of_version_4_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zstandard", None)
    (tmp_path / "a.spz").write_bytes(b"NGSP" + struct.pack("<I", 4) + bytes(24))
    with pytest.raises(MissingDependencyError, match=r"SPZ version 4 needs zstandard: .*dsar-avatar\[ply\]"):
        find_faults(tmp_path / "a.spz")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content[: len(content) // 2], "broken: Compressed file ended before the end"),
        (lambda content: content[:20], "gzip that is broken: Compressed file ended before"),
        (lambda content: gzip.compress(gzip.decompress(content)[:-99]), "broken: SPZ payload too small"),
        (lambda content: gzip.compress(b"something else"), "found one that starts with b'some'"),
        (lambda content: b"nonsense", "found one that starts with b'nons'"),
        (lambda content: b"", "found an empty file"),
    ],
)
def test_a_broken_spz_is_one_true_line(written, change, message):
    written["spz"].write_bytes(change(written["spz"].read_bytes()))
    with pytest.raises(ExportError, match=message):
        find_faults(written["spz"])


def test_sizes_of_an_spz_are_held_against_its_cloud(written):
    content = bytearray(gzip.decompress(written["spz"].read_bytes()))
    scales = 16 + 13 * 600
    content[scales : scales + 3 * 600] = bytes([255]) * (3 * 600)
    written["spz"].write_bytes(gzip.compress(bytes(content)))
    (fault,) = find_faults(written["spz"])
    assert "found 600 of 600 with standard deviations up to 379" in fault


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
