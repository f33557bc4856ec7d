"""Blender imports the asset: instances that move, skeleton, cameras, and a picture that overlaps ours."""

import dataclasses
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from dsar.geometry.camera_paths import turntable
from dsar.raster import rasterize
from dsar_exporters import write_ply, write_usd

ROOT = Path(__file__).parents[2]
FRAMES = (1001, 1006)
# Blender's axes are x right, y back, z up: ours (x, y, z) are its (x, -z, y).
OURS = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.fixture(scope="module")
def imported(blender, figure, front, tmp_path_factory):
    folder = tmp_path_factory.mktemp("blender")
    asset = write_usd(figure, folder / "anna.usda", name="anna", cameras=[front])
    splats = write_ply(figure, folder / "ply", name="anna")
    arguments = [
        *(blender, ROOT / "tests" / "interop" / "blender_probe.py", ROOT / "examples" / "blender_import.py"),
        *(asset, splats[0], folder, front.name, front.width, front.height, *FRAMES),
    ]
    subprocess.run([*map(str, arguments)], check=True, capture_output=True, timeout=300)
    return folder, json.loads((folder / "facts.json").read_text())


def test_blender_finds_everything_at_its_rate(imported, figure):
    _, facts = imported
    assert {"ARMATURE", "CAMERA", "POINTCLOUD"} <= set(facts["types"])
    assert facts["cameras"] == ["front", "turntable"]
    assert facts["range"] == [1001, 1006]
    assert facts["rate"] == figure.fps


def test_blenders_instances_stand_where_the_gaussians_do(imported, figure):
    _, facts = imported
    for frame in FRAMES:
        places = np.array(facts["instances"][str(frame)]) @ OURS.T
        assert np.abs(places - dict(figure)[frame].means.numpy()).max() < 1e-4


def test_blenders_bones_follow_the_joints(imported, figure):
    _, facts = imported
    binding = figure.binding
    for frame in FRAMES:
        transforms = binding.T_world_rest[frame - 1001]
        joints = (transforms[:, :3, :3] @ binding.body.joints[..., None]).squeeze(-1) + transforms[:, :3, 3]
        bones = facts["bones"][str(frame)]
        found = np.array([bones[name] for name in binding.joint_names]) @ OURS.T
        assert np.abs(found - joints.numpy()).max() < 1e-3


def test_blenders_turntable_stands_where_ours_does(imported, figure, front):
    _, facts = imported
    circling = turntable(
        figure.binding, figure.frame_numbers, figure.fps, width=front.width, height=front.height
    )
    for frame in FRAMES:
        found = OURS @ facts["turntable"][str(frame)]
        assert np.abs(found - circling.at(frame).center.numpy()).max() < 1e-3


def test_a_cycles_picture_from_the_exported_camera_overlaps_ours(imported, figure, front):
    folder, _ = imported
    for frame in FRAMES:
        picture = np.asarray(Image.open(folder / f"{frame}.png").convert("RGBA"), np.float32) / 255
        assert picture.shape == (front.height, front.width, 4)
        gaussians = dict(figure)[frame]
        # Ellipsoids are opaque out to two standard deviations.
        solid = dataclasses.replace(gaussians, opacities=torch.full_like(gaussians.opacities, 0.999))
        ours = rasterize(solid, front)
        mine, theirs = ours.alpha.numpy() > 0.5, picture[..., 3] > 0.5
        assert (mine & theirs).sum() / (mine | theirs).sum() > 0.93
        both = mine & theirs
        straight = (ours.color / ours.alpha.clamp_min(1e-3)[..., None]).numpy()
        assert np.abs(straight[both] - picture[..., :3][both]).mean() < 0.06
