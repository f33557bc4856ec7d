"""Mattes, read as the Cryptomatte specification says."""

import dataclasses
import json
import re
import struct
from pathlib import Path

import mmh3
import numpy as np
import pytest
import torch
from exr_files import (
    bits,
    channels_of,
    parts_of,
    rgba_of,
    unprefixed,
    write,
)

from dsar.types import Aovs, Picture, RenderOutput
from dsar_exporters.exr.cryptomatte import float_id, matte_channels
from dsar_render.triplets import iterate_triplets


def murmur(name: str) -> int:
    """MurmurHash3_x86_32 with seed 0, from its published description."""

    def rotated(value: int, by: int) -> int:
        return (value << by | value >> 32 - by) & 0xFFFFFFFF

    def scrambled(word: int) -> int:
        return rotated(word * 0xCC9E2D51 & 0xFFFFFFFF, 15) * 0x1B873593 & 0xFFFFFFFF

    data, state = name.encode(), 0
    whole = len(data) // 4 * 4
    for (word,) in struct.iter_unpack("<I", data[:whole]):
        state = (rotated(state ^ scrambled(word), 13) * 5 + 0xE6546B64) & 0xFFFFFFFF
    state ^= scrambled(int.from_bytes(data[whole:], "little")) ^ len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        state = (state ^ state >> shift) * factor & 0xFFFFFFFF
    return state ^ state >> 16


def conforming(value: int) -> int:
    """The specification's correction: never a zero, denormal, infinite or undefined float."""
    return value ^ 1 << 23 if value >> 23 & 0xFF in (0, 0xFF) else value


@dataclasses.dataclass
class Mattes:
    """A Cryptomatte layer as a compositor's plug-in sees it."""

    manifest: dict[str, str]
    ids: np.ndarray
    """[h, w, ranks] as unsigned integers."""
    coverage: np.ndarray
    """[h, w, ranks]"""

    def matte(self, name: str) -> np.ndarray:
        return (self.coverage * (self.ids == int(self.manifest[name], 16))).sum(-1)


def decoded(path: Path, part: str = "") -> Mattes:
    """Decode a file's one layer as the specification 1.2 asks."""
    stored = {}
    for spec in parts_of(path):
        if part in str(spec.getattribute("oiio:subimagename")):
            stored |= {
                each.name: each.value for each in spec.extra_attribs if each.name.startswith("cryptomatte/")
            }
    keys = {name.split("/")[1] for name in stored}
    assert len(keys) == 1
    key = keys.pop()
    layer = stored[f"cryptomatte/{key}/name"]
    assert key == f"{murmur(layer):08x}"[:7]
    assert stored[f"cryptomatte/{key}/hash"] == "MurmurHash3_32"
    assert stored[f"cryptomatte/{key}/conversion"] == "uint32_to_float32"
    manifest = json.loads(stored[f"cryptomatte/{key}/manifest"])
    channels = unprefixed(
        {name: v for name, v in channels_of(path).items() if part in name.rpartition("/")[0]}
    )
    names = sorted(name for name in channels if re.fullmatch(rf"{layer}\d\d\.[RGBA]", name))
    numbers = sorted({name[len(layer) : len(layer) + 2] for name in names})
    assert numbers == [f"{index:02d}" for index in range(len(numbers))]
    pairs = [(f"{layer}{number}.{a}", f"{layer}{number}.{b}") for number in numbers for a, b in ("RG", "BA")]
    assert all(channels[name].dtype == np.float32 for name in names)
    ids = np.stack([np.ascontiguousarray(channels[name]).view(np.uint32) for name, _ in pairs], -1)
    return Mattes(manifest, ids, np.stack([channels[name] for _, name in pairs], -1))


@pytest.mark.parametrize(
    ("name", "published"),
    [
        ("", 0),
        ("test", 0xBA6BD213),
        ("hello", 0x248BFA47),
        ("Hello, world!", 0xC0363E43),
        ("The quick brown fox jumps over the lazy dog", 0x2E4FF723),
        # Of Psyop's own sample images.
        ("bunny", 0x13851A76),
        ("default", 0x42C9679F),
    ],
)
def test_hashes_are_the_published_ones(name, published):
    assert murmur(name) == mmh3.hash(name, 0, signed=False) == published
    if name:
        assert float_id(name).tobytes() == struct.pack("<I", published)
        assert float(float_id(name)) == struct.unpack("<f", struct.pack("<I", published))[0]


@pytest.mark.parametrize("exponent", [0, 255])
def test_ids_that_would_be_no_numbers_are_corrected_as_specified(exponent):
    names = [f"part{index}" for index in range(4000)]
    found = [name for name in names if murmur(name) >> 23 & 255 == exponent]
    assert len(found) > 5
    for name in found:
        number = float_id(name)
        assert np.isfinite(number)
        assert abs(number) >= np.finfo(np.float32).tiny
        assert number.view(np.uint32) == murmur(name) ^ 1 << 23


def test_mattes_are_the_pictures_coverage_and_sum_to_alpha(picture, labels, tmp_path):
    found = decoded(write(tmp_path, picture)[0])
    assert list(found.manifest) == list(labels.names)
    assert found.manifest == {name: f"{conforming(murmur(name)):08x}" for name in labels.names}
    assert {"garment", "head", "left_hand"} <= set(found.manifest)
    for name, coverage in picture.aovs.coverage.items():
        assert np.abs(found.matte(name) - coverage.numpy()).max() < 1e-6, name
        if name not in ("right_arm", "right_hand", "right_leg", "right_foot"):  # which the garment hides
            assert found.matte(name).max() > 0.5, name
    assert found.matte("garment").max() > 0.9
    total = sum(found.matte(name) for name in found.manifest)
    np.testing.assert_allclose(total, picture.output.alpha, atol=1e-6)
    # And what the file's own alpha says, in half floats.
    np.testing.assert_allclose(
        total, rgba_of(tmp_path / "front" / "avatar.front.1003.exr")[..., 3], atol=5e-4
    )


def test_every_rank_is_an_id_of_the_manifest_or_nothing(picture, side, tmp_path):
    for path in write(
        tmp_path, dataclasses.replace(picture, deep=None), dataclasses.replace(side, deep=None)
    ):
        found = decoded(path)
        known = {int(number, 16) for number in found.manifest.values()}
        assert set(np.unique(found.ids)) <= known | {0}
        # An id stands exactly where there is coverage, the largest first.
        np.testing.assert_array_equal(found.ids != 0, found.coverage > 0)
        assert (np.diff(found.coverage, axis=-1) <= 0).all()
        exponents = found.ids[found.ids != 0] >> 23 & 0xFF
        assert exponents.min() > 0
        assert exponents.max() < 255


@pytest.mark.parametrize(
    "settings",
    [{"compression": "dwaa"}, {"compression": "b44"}, {"crop": True}, {"views": "multipart"}],
    ids=str,
)
def test_mattes_survive_every_way_of_writing(picture, tmp_path, settings):
    sharp = decoded(write(tmp_path / "plain", picture)[0])
    found = decoded(write(tmp_path / "other", picture, **settings)[0])
    if settings.get("crop"):
        alpha = picture.output.alpha.numpy() > 0
        rows, columns = np.flatnonzero(alpha.any(1)), np.flatnonzero(alpha.any(0))
        inside = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        sharp = Mattes(sharp.manifest, sharp.ids[inside], sharp.coverage[inside])
    assert found.manifest == sharp.manifest
    assert bits(found.ids) == bits(sharp.ids)
    assert bits(found.coverage) == bits(sharp.coverage)


def test_blurred_mattes_sum_to_the_blurred_alpha(take, figure, tmp_path):
    (triplet,) = (each for each in iterate_triplets(figure, {1003}) if each.frame == 1003)
    blurred = take(triplet=triplet, motion_samples=3, shutter=(-0.5, 0.5))
    found = decoded(write(tmp_path, blurred)[0])
    total = sum(found.matte(name) for name in found.manifest)
    np.testing.assert_allclose(total, blurred.output.alpha, atol=2e-6)


def test_where_more_than_six_parts_meet_the_largest_stand_for_all(small, tmp_path):
    generator = torch.Generator().manual_seed(0)
    shares = torch.rand(9, 12, 16, generator=generator)
    alpha = torch.rand(12, 16, generator=generator)
    shares *= alpha / shares.sum(0)
    coverage = {f"part{index}": share for index, share in enumerate(shares)}
    output = RenderOutput(torch.zeros(12, 16, 3), alpha, alpha, torch.tensor(0))
    crowd = Picture(1001, small, output, Aovs(coverage=coverage))
    found = decoded(write(tmp_path, crowd, layers=("rgba", "crypto"))[0])
    np.testing.assert_allclose(found.coverage.sum(-1), alpha, rtol=1e-5)
    order = shares.argsort(0, descending=True)
    names = np.array([conforming(murmur(f"part{index}")) for index in range(9)], np.uint32)
    np.testing.assert_array_equal(found.ids, names[order[:6].permute(1, 2, 0).numpy()])


def test_a_single_part_is_a_layer_too():
    found = matte_channels({"all": torch.tensor([[0.5, 0.0]])})
    assert list(found) == ["CryptoMaterial00", "CryptoMaterial01", "CryptoMaterial02"]
    np.testing.assert_array_equal(found["CryptoMaterial00"], [[[float_id("all"), 0.5, 0, 0], [0, 0, 0, 0]]])
    assert not found["CryptoMaterial01"].any()
