"""Converters and viewers of others read our splat files: equal numbers, upright pictures like ours."""

import csv
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from dsar.geometry.cameras import world_from_camera
from dsar.raster import rasterize
from dsar.types import Gaussians, GaussianSequence
from dsar_exporters import (
    CompressedPlySequence,
    GltfSnapshot,
    PlySequence,
    SpzSequence,
    export,
    read_ply,
)


@pytest.fixture(scope="module")
def splats(figure, tmp_path_factory) -> Path:
    """A folder with one frame in every splat format."""
    folder = tmp_path_factory.mktemp("splats")
    _, first = next(iter(figure))
    # Harmonics of degree 1 with a mark of their own in every coefficient and channel.
    marks = torch.linspace(-0.4, 0.5, 9).reshape(1, 3, 3) * (0.5 + first.means[:, None, :1])
    harmonics = torch.cat([first.harmonics, marks], 1)
    rich = Gaussians(first.means, first.rotations, first.scales, first.opacities, harmonics)
    sequence = GaussianSequence([1001], 24.0, len(rich), lambda: iter([rich]))
    outputs = [
        PlySequence(folder / "ply", "a"),
        CompressedPlySequence(folder / "small", "a"),
        SpzSequence(folder / "spz", "a"),
        GltfSnapshot(folder / "a.glb"),
    ]
    export(sequence, outputs)
    return folder


@pytest.fixture(scope="module")
def truth(splats) -> Gaussians:
    return read_ply(splats / "ply" / "a.1001.ply")


def convert(command: list[str], source: Path, target: Path) -> Path:
    subprocess.run([*command, "-q", "-w", str(source), str(target)], check=True, timeout=120)
    return target


def nearest(found: Gaussians, truth: Gaussians) -> torch.Tensor:
    """Return which true Gaussian each found one is: formats that compress reorder them."""
    order = torch.cdist(found.means, truth.means).argmin(1)
    assert len(set(order.tolist())) > 0.97 * len(truth)
    return order


def check(
    found: Gaussians, truth: Gaussians, means: float, scales: float, colors: float, turns: float
) -> None:
    assert len(found) == len(truth)
    order = nearest(found, truth)
    assert (found.means - truth.means[order]).abs().amax() < means
    assert (found.scales / truth.scales[order] - 1).abs().quantile(0.98) < scales
    assert (found.opacities - truth.opacities[order]).abs().quantile(0.98) < 0.01
    assert (found.harmonics[:, 0] - truth.harmonics[order, 0]).abs().quantile(0.98) < colors
    assert ((found.rotations * truth.rotations[order]).sum(-1).abs()).quantile(0.02) > 1 - turns


def test_splat_transform_reads_our_ply_and_writes_the_same_numbers(splat_transform, splats, truth, tmp_path):
    source = splats / "ply" / "a.1001.ply"
    again = read_ply(convert(splat_transform, source, tmp_path / "again.ply"))
    for name in ("means", "scales", "opacities", "harmonics"):
        assert torch.allclose(getattr(again, name), getattr(truth, name), atol=1e-6), name
    assert ((again.rotations * truth.rotations).sum(-1).abs() > 1 - 1e-6).all()


def test_splat_transform_sees_our_columns(splat_transform, splats, truth, tmp_path):
    table = convert(splat_transform, splats / "ply" / "a.1001.ply", tmp_path / "table.csv")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert len(rows) == len(truth)
    rest = np.array([[float(row[f"f_rest_{i}"]) for i in range(9)] for row in rows[:50]])
    # Channel-major: three coefficients of red, then of green, then of blue.
    assert np.allclose(rest.reshape(-1, 3, 3).transpose(0, 2, 1), truth.harmonics[:50, 1:], atol=1e-5)


def test_splat_transform_reads_our_spz(splat_transform, splats, truth, tmp_path):
    found = read_ply(convert(splat_transform, splats / "spz" / "a.1001.spz", tmp_path / "spz.ply"))
    # SPZ has x right, y up, z back; splat-transform turns it to y down, z forward, as most PLY files are.
    signs = torch.tensor([1.0, -1.0, -1.0])
    found = Gaussians(
        found.means * signs,
        found.rotations * torch.tensor([1.0, 1.0, -1.0, -1.0]),
        found.scales,
        found.opacities,
        found.harmonics * torch.tensor([1.0, -1.0, -1.0, 1.0])[:, None],
    )
    check(found, truth, means=3e-4, scales=0.04, colors=0.03, turns=2e-3)
    order = nearest(found, truth)
    assert (found.harmonics[:, 1:] - truth.harmonics[order, 1:]).abs().quantile(0.98) < 0.07


def test_splat_transform_reads_our_compressed_ply(splat_transform, splats, truth, tmp_path):
    source = splats / "small" / "a.1001.compressed.ply"
    found = read_ply(convert(splat_transform, source, tmp_path / "small.ply"))
    check(found, truth, means=2e-3, scales=0.02, colors=0.03, turns=2e-3)


def photograph(node, node_modules, chromium, splats: Path, camera, out: Path) -> torch.Tensor:
    K = camera.K
    view = {
        "width": camera.width,
        "height": camera.height,
        "fovy": float(torch.rad2deg(2 * torch.atan(camera.height / (2 * K[1, 1])))),
        "world": world_from_camera(camera, "opengl").tolist(),
    }
    script = Path(__file__).with_name("viewer.mjs")
    arguments = [node, script, node_modules, splats, chromium, json.dumps(view), out]
    subprocess.run([*map(str, arguments)], check=True, timeout=240)
    return torch.from_numpy(np.asarray(Image.open(out).convert("RGB"), np.float32) / 255)


@pytest.mark.parametrize("kind", ["ply/a.1001.ply", "spz/a.1001.spz", "small/a.1001.compressed.ply"])
def test_a_web_viewer_shows_our_file_upright_and_as_we_draw_it(
    node, node_modules, chromium, splats, truth, front, tmp_path, kind
):
    # three.js has a principal point in the middle only.
    K = front.K.clone()
    K[0, 2], K[1, 2] = front.width / 2, front.height / 2
    camera = type(front)(K, front.T_camera_world, front.width, front.height, "middle")
    shown = photograph(node, node_modules, chromium, splats / kind, camera, tmp_path / "shown.png")
    ours = rasterize(truth, camera, background=torch.ones(3)).color.clamp(0, 1)
    error = float((shown - ours).square().mean().sqrt())
    others = {"upside down": ours.flip(0), "mirrored": ours.flip(1), "turned": ours.flip(0, 1)}
    for name, picture in others.items():
        assert float((shown - picture).square().mean().sqrt()) > 3 * error, name
    assert error < 0.05
