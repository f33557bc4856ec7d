import subprocess
import sys

import pytest
import torch

from dsar.errors import MissingDependencyError
from dsar.types import Camera, Gaussians, GaussianSequence, RenderOutput
from dsar_exporters import (
    CompressedPlySequence,
    GltfSnapshot,
    SpzSequence,
    export,
    read_ply,
    read_splats,
    write_exr,
    write_ply,
    write_usd,
)
from dsar_render import write_mp4

OPTIONAL = (
    "pxr",
    "OpenEXR",
    "OpenImageIO",
    "plyfile",
    "gsply",
    "fourdgs",
    "imageio_ffmpeg",
    "mitsuba",
    "flip_evaluator",
)


def _no_frames():
    raise AssertionError("a frame was produced before the package was looked for")
    yield Gaussians  # makes this a generator function


@pytest.mark.parametrize(
    ("module", "extra", "call"),
    [
        ("plyfile", "ply", lambda folder, sequence: write_ply(sequence, folder, name="a")),
        ("plyfile", "ply", lambda folder, _: read_ply(folder / "a.ply")),
        ("pxr.UsdVol", "usd", lambda folder, sequence: write_usd(sequence, folder / "a.usda", name="a")),
        ("gsply", "ply", lambda folder, sequence: export(sequence, [SpzSequence(folder / "s", "a")])),
        (
            "gsply",
            "ply",
            lambda folder, sequence: export(sequence, [CompressedPlySequence(folder / "s", "a")]),
        ),
        ("gsply", "ply", lambda folder, _: read_splats(folder / "a.spz")),
        ("fourdgs", "ply", lambda folder, sequence: export(sequence, [GltfSnapshot(folder / "a.glb")])),
        ("imageio_ffmpeg", "video", lambda folder, _: write_mp4(_no_frames(), folder / "a.mp4", fps=24.0)),
    ],
    ids=["write_ply", "read_ply", "write_usd", "spz", "compressed", "read_splats", "glb", "write_mp4"],
)
def test_a_missing_package_is_named_with_its_extra_before_any_work(
    monkeypatch, tmp_path, module, extra, call
):
    monkeypatch.setitem(sys.modules, module, None)
    sequence = GaussianSequence([1001], 24.0, 1, _no_frames)
    with pytest.raises(MissingDependencyError, match=rf"pip install 'dsar-avatar\[{extra}\]'"):
        call(tmp_path, sequence)
    assert not list(tmp_path.iterdir())


def test_exr_without_openexr_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    image = RenderOutput(torch.zeros(2, 2, 3), torch.zeros(2, 2), torch.zeros(2, 2), torch.tensor(0))
    camera = Camera(torch.eye(3), torch.eye(4), 2, 2, "cam")
    with pytest.raises(MissingDependencyError, match=r"dsar-avatar\[exr\]"):
        write_exr(image, tmp_path / "a.exr", camera=camera, frame=1, fps=24.0, provenance={})


def test_importing_the_packages_loads_no_optional_one():
    code = f"import sys, dsar_exporters, dsar_render; print([m for m in {OPTIONAL} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert found.stdout.strip() == "[]"
