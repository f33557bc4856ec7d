"""SPZ files: read or refused by their version, faults told."""

import gzip
import struct
import sys

import gsply
import pytest
import torch

from dsar.errors import ExportError, MissingDependencyError
from dsar_exporters import find_faults, read_splats


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
