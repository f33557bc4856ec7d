"""Several formats from one rollout, and what is left when an export is stopped, killed or out of space."""

import dataclasses
import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from faults import full_disk
from pxr import Usd

from dsar.errors import ExportError, StorageError
from dsar_exporters import (
    CompressedPlySequence,
    GltfSnapshot,
    PlySequence,
    SpzSequence,
    UsdAsset,
    export,
    find_faults,
    read_ply,
    write_ply,
    write_usd,
)


def every_format(folder: Path) -> list:
    return [
        UsdAsset(folder / "a.usda", "anna"),
        PlySequence(folder / "ply", "anna"),
        CompressedPlySequence(folder / "small", "anna"),
        SpzSequence(folder / "spz", "anna"),
        GltfSnapshot(folder / "a.glb"),
    ]


def test_every_format_comes_from_one_rollout(make_sequence, tmp_path):
    sequence = make_sequence(300, frames=3, step=2)
    passes = []

    def produce():
        passes.append(1)
        return sequence.produce()

    delivered = export(dataclasses.replace(sequence, produce=produce), every_format(tmp_path))
    assert len(passes) == 1
    assert [each.path.name for each in delivered] == ["a.usda", "ply", "small", "spz", "a.glb"]
    for each in delivered:
        manifest = json.loads((tmp_path / f"{each.path.name}.manifest.json").read_text())
        files = [tmp_path / name for name in manifest["files"]]
        assert len(files) + 1 == each.files
        assert sum(file.stat().st_size for file in files) < each.size
        assert manifest["frames"]["fps"] == 24
        assert manifest["gaussians"] == 300
        assert manifest["provenance"] == {"motion": "swing"}
    frames = json.loads((tmp_path / "ply.manifest.json").read_text())["frames"]
    assert frames["range"] == "1001-1005x2"
    assert (frames["count"], frames["first"], frames["last"]) == (3, 1001, 1005)
    for folder, suffix in (("ply", ".ply"), ("small", ".compressed.ply"), ("spz", ".spz")):
        names = sorted(path.name for path in (tmp_path / folder).iterdir())
        assert names == [f"anna.{frame}{suffix}" for frame in (1001, 1003, 1005)]
        assert find_faults(tmp_path / folder / names[0]) == []


def test_estimates_are_near_what_is_written(make_sequence, tmp_path):
    def change(index, g):
        scales, opacities = g.scales * (1 + index / 10), g.opacities * (1 - index / 10)
        return dataclasses.replace(g, scales=scales, opacities=opacities, harmonics=g.harmonics + index)

    sequence = make_sequence(2000, 1, frames=8, change=change)
    _, first = next(iter(sequence))
    outputs = [*every_format(tmp_path), UsdAsset(tmp_path / "half.usda", "anna", half=True)]
    for output, delivered in zip(outputs, export(sequence, outputs), strict=True):
        assert output.estimated_bytes(first, len(sequence)) == pytest.approx(delivered.size, rel=0.25)


def test_two_outputs_may_not_share_a_place(make_sequence, tmp_path):
    outputs = [PlySequence(tmp_path, "a"), SpzSequence(tmp_path, "b")]
    with pytest.raises(ExportError, match="expected each place once"):
        export(make_sequence(), outputs)
    assert not list(tmp_path.iterdir())


def test_players_of_whole_folders_are_warned_of_older_frames(make_sequence, tmp_path, caplog):
    write_ply(make_sequence(frames=4), tmp_path / "ply", name="anna")
    assert "already holds" not in caplog.text
    write_ply(make_sequence(frames=2), tmp_path / "ply", name="anna")
    assert "already holds 2 files of other frames, such as anna.1003.ply" in caplog.text


def test_a_broken_rollout_leaves_every_older_file_whole(make_sequence, breaking_sequence, tmp_path):
    older = make_sequence(frames=2)
    export(older, every_format(tmp_path))
    before = {path: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    with pytest.raises(RuntimeError, match="the network failed"):
        export(breaking_sequence, every_format(tmp_path))
    assert {path: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before
    assert len(list((tmp_path / "ply").iterdir())) == 2


@pytest.mark.parametrize("kind", range(5), ids=["usd", "ply", "compressed", "spz", "glb"])
def test_a_folder_that_cannot_be_made_is_one_error(make_sequence, tmp_path, kind):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match=r"file.*cannot be written: .*: give another path"):
        export(make_sequence(), [every_format(tmp_path / "file")[kind]])


def test_a_disk_that_may_be_too_small_is_told_before_anything_is_written(
    make_sequence, tmp_path, monkeypatch, caplog
):
    asked = []
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr(
        "dsar_exporters.delivery.shutil.disk_usage", lambda folder: asked.append(folder) or usage
    )
    write_ply(make_sequence(2000), tmp_path, name="anna")
    assert "its disk has 0 MB free, of about 1 MB needed" in caplog.text
    assert asked == [tmp_path]


WRITE = """
import sys, time, torch
from pathlib import Path
from dsar.types import Gaussians, GaussianSequence
from dsar_exporters import UsdAsset, PlySequence, export
from dsar.errors import DsarError

def produce():
    generator = torch.Generator().manual_seed(0)
    for frame in range({frames}):
        yield Gaussians(
            torch.randn({count}, 3, generator=generator),
            torch.nn.functional.normalize(torch.randn({count}, 4, generator=generator), dim=-1),
            torch.rand({count}, 3, generator=generator) + 0.01,
            torch.rand({count}, generator=generator),
            torch.randn({count}, 1, 3, generator=generator),
        )
        time.sleep({pause})
        print(frame, flush=True)

folder = Path(sys.argv[1])
sequence = GaussianSequence(range(1001, 1001 + {frames}), 24.0, {count}, produce)
outputs = [UsdAsset(folder / "a.usda", "anna", clips={clips}), PlySequence(folder / "ply", "anna")]
if not {ply}:
    del outputs[1]
try:
    export(sequence, outputs)
except DsarError as error:
    sys.exit(str(error))
"""


def write_elsewhere(
    folder: Path, frames: int, count: int, pause: float, clips: bool, ply: bool = True, **options
):
    script = WRITE.format(frames=frames, count=count, pause=pause, clips=clips, ply=ply)
    return subprocess.Popen(
        [sys.executable, "-c", script, str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        **options,
    )


@pytest.mark.parametrize("clips", [False, True], ids=["payload", "clips"])
@pytest.mark.parametrize("after", [1, 5, 19, "the last frame"])
def test_a_killed_export_leaves_no_broken_file(tmp_path, make_sequence, after, clips):
    write_usd(make_sequence(frames=2), tmp_path / "a.usda", name="old", clips=clips)
    process = write_elsewhere(tmp_path, 20, 500, 0.0, clips)
    assert process.stdout is not None
    for line in process.stdout:
        if after != "the last frame" and int(line) == after:
            break
    else:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    # The old asset until the new one is whole; none in the moment of exchange; never a broken one.
    asset = tmp_path / "a.usda"
    if after in (1, 5):
        assert Usd.Stage.Open(str(asset)).GetDefaultPrim().GetName() == "old"
    if asset.exists():
        assert find_faults(asset) == []
    for file in (tmp_path / "ply").glob("*.ply"):
        assert len(read_ply(file)) == 500


@pytest.mark.parametrize("clips", [False, True], ids=["payload", "clips"])
def test_a_full_disk_is_one_error_and_leaves_the_older_asset(tmp_path, make_sequence, clips):
    write_usd(make_sequence(frames=2), tmp_path / "a.usda", name="old", clips=clips)
    before = (tmp_path / "a.usda").read_bytes()

    def limit() -> None:
        # No file may be larger: to the program it is the same as a disk that is full.
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))

    process = write_elsewhere(tmp_path, 3, 2000, 0.0, clips, ply=False, preexec_fn=limit)
    _, message = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "a.usda: cannot be written: File too large: free some room there" in message
    assert (tmp_path / "a.usda").read_bytes() == before
    assert find_faults(tmp_path / "a.usda") == []
    assert not list(tmp_path.glob(".a.usda*"))


def test_a_full_disk_leaves_whole_splat_files_only(tmp_path):
    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))

    process = write_elsewhere(tmp_path, 3, 2000, 0.0, False, preexec_fn=limit)
    _, message = process.communicate(timeout=60)
    assert "ply: cannot be written: File too large" in message
    assert not list((tmp_path / "ply").iterdir())
    assert not list(tmp_path.glob("*a.usda*"))


@pytest.mark.parametrize("kind", range(1, 5), ids=["ply", "compressed", "spz", "glb"])
@pytest.mark.parametrize("missing", [1, 500])
def test_a_disk_that_takes_all_but_the_end_is_noticed(make_sequence, tmp_path, kind, missing):
    """Libraries in C do not look whether the last kilobytes of a file were taken when they close it."""
    export(make_sequence(frames=1), [every_format(tmp_path / "whole")[kind]])
    size = max(path.stat().st_size for path in (tmp_path / "whole").rglob("*") if path.suffix != ".json")
    with full_disk(size - missing), pytest.raises(StorageError, match="free some room"):
        export(make_sequence(frames=1), [every_format(tmp_path / "cut")[kind]])
    assert not [path for path in (tmp_path / "cut").rglob("*") if path.is_file()]


def test_an_output_that_cannot_be_finished_does_not_take_the_others_with_it(
    make_sequence, tmp_path, monkeypatch
):
    def refuse(*_):
        raise ExportError("this asset is not to be")

    monkeypatch.setattr("dsar_exporters.usd.validation.refuse_faults", refuse)
    with pytest.raises(ExportError, match="not to be"):
        export(make_sequence(), every_format(tmp_path))
    assert not list(tmp_path.glob("*a.usda*"))
    for name in ("ply.manifest.json", "small.manifest.json", "spz.manifest.json", "a.glb"):
        assert (tmp_path / name).exists()


def test_an_asset_that_cannot_be_put_in_place_leaves_the_older_one(make_sequence, tmp_path, monkeypatch):
    path = write_usd(make_sequence(frames=2), tmp_path / "a.usda", name="old", clips=True)
    before = {each: each.read_bytes() for each in tmp_path.rglob("*") if each.is_file()}
    replace = os.replace

    def fail_at_the_root(source, target):
        if Path(target) == path and "replaced" not in str(source):
            raise PermissionError(13, "Permission denied")
        replace(source, target)

    monkeypatch.setattr("dsar.atomic_files.os.replace", fail_at_the_root)
    with pytest.raises(StorageError, match=r"a\.usda: cannot be written: Permission denied: write elsewhere"):
        write_usd(make_sequence(frames=3), path, name="new", clips=True)
    assert {each: each.read_bytes() for each in tmp_path.rglob("*") if each.is_file()} == before


def test_clips_of_others_are_not_replaced_and_old_ones_are_told(make_sequence, tmp_path, caplog):
    path = write_usd(make_sequence(frames=2), tmp_path / "a.usda", name="a", clips=True)
    write_usd(make_sequence(frames=2), path, name="a")
    assert "a.clips: the clips of an earlier export are not used any more" in caplog.text
    (tmp_path / "b.clips").mkdir()
    (tmp_path / "b.clips" / "holiday.mp4").write_bytes(b"")
    with pytest.raises(ExportError, match="expected the value clips of an earlier export or nothing"):
        write_usd(make_sequence(frames=2), tmp_path / "b.usda", name="b", clips=True)
    assert (tmp_path / "b.clips" / "holiday.mp4").exists()


def test_the_working_folder_can_be_the_output(make_sequence, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    write_ply(make_sequence(frames=1), Path("."), name="a")
    write_usd(make_sequence(frames=1), Path("a.usda"), name="a")
    assert json.loads((tmp_path / "here.manifest.json").read_text())["files"] == ["here/a.1001.ply"]
    assert find_faults(Path("a.usda")) == []


@pytest.mark.parametrize(
    ("field", "factor", "message"),
    [
        ("opacities", 3.0, "frame 1003: expected opacities from 0 to 1, found"),
        ("scales", -1.0, "frame 1003: expected scales from 0 to inf, found -"),
        ("rotations", 1.1, "frame 1003: expected lengths of quaternions from 0.999 to 1.001, found 1.1"),
    ],
)
def test_values_that_are_not_physical_are_refused_by_frame(make_sequence, tmp_path, field, factor, message):
    def change(index, g):
        return dataclasses.replace(g, **{field: getattr(g, field) * factor}) if index == 2 else g

    with pytest.raises(ExportError, match=message):
        write_usd(make_sequence(change=change), tmp_path / "a.usda", name="a")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (
            0,
            "frame 1001: expected finite scales, found 15 values that are not; finite opacities, found 5 .*: "
            "the checkpoint or the motion holds such values, or the network made them at once: look at both$",
        ),
        (
            2,
            "frame 1003: expected finite scales, .*: frame 1002 is finite: the motion holds such values "
            "there, or the network made them on the way: look at the motion, or export frames up to 1002$",
        ),
    ],
)
def test_values_that_are_not_finite_are_told_without_blaming_one_cause(
    make_sequence, tmp_path, broken, message
):
    def change(index, g):
        spoilt = {"scales": g.scales / 0, "opacities": g.opacities * float("nan")}
        return dataclasses.replace(g, **spoilt) if index == broken else g

    with pytest.raises(ExportError, match=message):
        write_usd(make_sequence(change=change), tmp_path / "a.usda", name="a")


def test_gaussians_without_extent_get_a_little_one(make_sequence, tmp_path):
    sequence = make_sequence(change=lambda _, g: dataclasses.replace(g, scales=0 * g.scales))
    assert find_faults(write_usd(sequence, tmp_path / "a.usda", name="a")) == []


def test_spz_and_compressed_ply_keep_what_their_formats_can(make_sequence, tmp_path):
    from dsar_exporters import read_splats

    sequence = make_sequence(500, 1, frames=1)
    export(sequence, [SpzSequence(tmp_path / "spz", "a"), CompressedPlySequence(tmp_path / "ply", "a")])
    _, gaussians = next(iter(sequence))
    spz = read_splats(tmp_path / "spz" / "a.1001.spz")
    assert torch.allclose(spz.means, gaussians.means, atol=3e-4)
    assert torch.allclose(spz.scales, gaussians.scales, rtol=0.035)
    assert torch.allclose(spz.opacities, gaussians.opacities, atol=0.01)
    assert ((spz.rotations * gaussians.rotations).sum(-1).abs() > 0.9995).all()
    assert torch.allclose(spz.harmonics[:, 0], gaussians.harmonics[:, 0].clamp(-3.3, 3.3), atol=0.04)
    small = read_splats(tmp_path / "ply" / "a.1001.compressed.ply")
    span = gaussians.means.amax(0) - gaussians.means.amin(0)
    assert ((small.means - gaussians.means).abs() < span / 1000).all(), "in order"


def test_a_glb_says_that_its_colours_are_for_display(make_sequence, tmp_path):
    import struct

    sequence = make_sequence(40, 1, frames=2)
    export(sequence, [GltfSnapshot(tmp_path / "a.glb")])
    blob = (tmp_path / "a.glb").read_bytes()
    (length,) = struct.unpack_from("<I", blob, 12)
    document = json.loads(blob[20 : 20 + length])
    (primitive,) = document["meshes"][0]["primitives"]
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert extension == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    _, gaussians = next(iter(sequence))

    def values(name: str) -> torch.Tensor:
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        start = 20 + length + 8 + view["byteOffset"]
        flat = torch.frombuffer(bytearray(blob[start : start + view["byteLength"]]), dtype=torch.float32)
        return flat.reshape(accessor["count"], -1)

    prefix = "KHR_gaussian_splatting"
    assert torch.allclose(values("POSITION"), gaussians.means, atol=1e-6)
    assert torch.allclose(values(f"{prefix}:SCALE"), gaussians.scales)
    assert torch.allclose(values(f"{prefix}:ROTATION"), gaussians.rotations[:, [1, 2, 3, 0]])
    assert torch.allclose(values(f"{prefix}:OPACITY")[:, 0], gaussians.opacities)
    assert torch.allclose(values(f"{prefix}:SH_DEGREE_0_COEF_0"), gaussians.harmonics[:, 0], atol=1e-5)
    for k in range(3):
        found = values(f"{prefix}:SH_DEGREE_1_COEF_{k}")
        assert torch.allclose(found, gaussians.harmonics[:, 1 + k].clamp(-4, 4), atol=0.016)


def test_a_glb_of_nothing_and_of_another_name_is_refused(make_sequence, tmp_path):
    with pytest.raises(ExportError, match=r"expected a name ending in \.glb"):
        export(make_sequence(), [GltfSnapshot(tmp_path / "a.gltf")])
    with pytest.raises(ExportError, match="expected at least one Gaussian"):
        export(make_sequence(0), [GltfSnapshot(tmp_path / "a.glb")])
    assert not list(tmp_path.iterdir())
