"""Cameras that went through Blender, imported and exported again, see what ours saw."""

import dataclasses
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from dsar.geometry.camera_paths import turntable
from dsar.geometry.cameras import project
from dsar.types import Camera
from dsar_exporters import read_usd_cameras, write_usd

ROOT = Path(__file__).parents[2]
FRAMES = range(1001, 1007)
POINTS = torch.rand(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
# Blender fits a lens to the larger side, so that each has its own way through it.
SIZES = {"portrait": (192, 256), "landscape": (1920, 1080)}
WRITTEN = ("default", "converted")


@pytest.fixture(scope="module", params=SIZES)
def exported(request, blender, figure, front, tmp_path_factory):
    """Blender's folder, and the camera at rest that went in."""
    width, height = SIZES[request.param]
    K = torch.tensor([[300.0, 0.0, 100.0], [0.0, 300.0, 90.0], [0.0, 0.0, 1.0]]) * (height / 256)
    K[2, 2] = 1.0
    shifted = dataclasses.replace(front, K=K, width=width, height=height)
    folder = tmp_path_factory.mktemp("blender")
    asset = write_usd(figure, folder / "anna.usda", name="anna", cameras=[shifted])
    probe = ROOT / "tests" / "interop" / "blender_cameras_probe.py"
    arguments = [blender, probe, asset, folder, width, height]
    subprocess.run([*map(str, arguments)], check=True, capture_output=True, timeout=300)
    return folder, shifted


def pixels(camera: Camera) -> np.ndarray:
    found, depth = project(camera, POINTS)
    assert (depth > 0).all()
    return found.numpy()


def cameras_of(exported, written: str):
    folder, front = exported
    size = (front.width, front.height)
    return read_usd_cameras(folder / f"{written}.usda", frames=FRAMES, resolution=size, fps=24.0)


@pytest.mark.parametrize("written", WRITTEN)
def test_cameras_that_went_through_blender_see_what_ours_saw(exported, figure, written):
    _, front = exported
    still, moving = sorted(cameras_of(exported, written), key=lambda path: path.name)
    assert (still.frames, moving.frames) == ((), tuple(range(1000, 1008)))
    assert np.abs(pixels(still.at(1001)) - pixels(front)).max() < 0.05
    circling = turntable(figure.binding, FRAMES, 24.0, width=front.width, height=front.height)
    for frame in FRAMES:
        assert np.abs(pixels(moving.at(frame)) - pixels(circling.at(frame))).max() < 0.05


@pytest.mark.parametrize("written", WRITTEN)
def test_cameras_are_called_as_blenders_objects(exported, written):
    names = sorted(path.name for path in cameras_of(exported, written))
    assert names == ["front_door_001", "turntable"]
