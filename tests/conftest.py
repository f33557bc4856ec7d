"""A tiny capture on disk, in the documented format: a speckled body that sways, seen by four cameras."""

import fcntl
import json
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests import type_checks

# Before anything of ours is imported.
type_checks.install()

# Small tensors gain nothing from a second thread and lose much to spinning ones.
torch.set_num_threads(1)

SIZE = (48, 64)
FRAMES = {"sway": 12, "turn": 14, "bend": 10}


def pytest_collection_modifyitems(items):
    """Skip what needs a GPU where there is none, and say so."""
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip(reason="no CUDA device"))


def motions():
    from dsar.types import Motion

    made = {}
    for index, (name, frames) in enumerate(FRAMES.items()):
        t = torch.arange(frames) / 30
        rotations, translations = torch.zeros(frames, 55, 3), torch.zeros(frames, 3)
        rotations[:, 16, 2], rotations[:, 17, 2] = -1.1, 1.1
        rotations[:, 0, 1] = (1 + index) * t
        rotations[:, 3, 0] = 0.4 * torch.sin(8 * t) * index
        translations[:, 0] = 0.1 * torch.sin(6 * t)
        made[name] = Motion(rotations, translations, 30.0, name)
    return made


def cameras():
    from dsar.geometry.cameras import look_at
    from dsar.types import Camera

    K = torch.tensor([[70.0, 0.0, SIZE[0] / 2], [0.0, 70.0, SIZE[1] / 2], [0.0, 0.0, 1.0]])
    places = [(math.sin(a) * 2.4, 0.3, math.cos(a) * 2.4) for a in (0.0, 1.6, 3.1, 4.7)]
    target = np.zeros(3)
    return [Camera(K, look_at(np.array(place), target), *SIZE, f"cam{i}") for i, place in enumerate(places)]


def speckled(body, motion):
    """Yield the Gaussians of a body with a fixed random colour at each texel."""
    from dsar.avatar.avatar import Avatar
    from dsar.avatar.charts import Atlas, body_chart
    from dsar.avatar.rollout import roll_out
    from dsar.config import ModelConfig

    generator = torch.Generator().manual_seed(5)
    avatar = Avatar(body, Atlas.stack([body_chart(body, 32)]), ModelConfig(channels=(4, 8), heads=2), 30.0)
    with torch.no_grad():
        avatar.template.harmonics.copy_(torch.randn(avatar.num_gaussians, 1, 3, generator=generator))
        avatar.template.opacity_logits.fill_(4.0)
    for _, gaussians in roll_out(avatar, motion):
        yield gaussians


def made_once(tmp_path_factory, name: str, make: Callable[[Path], None]) -> Path:
    """Return a folder that one of the processes that share the tests makes, and the others wait for."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent
    folder = base / f"once-{name}"
    with (base / f"once-{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            draft = base / f"once-{name}.draft"
            shutil.rmtree(draft, ignore_errors=True)
            draft.mkdir()
            make(draft)
            draft.rename(folder)
    return folder


@pytest.fixture(scope="session")
def tiny_capture(tmp_path_factory) -> Path:
    """Return the folder of the tiny capture, which nobody may write to."""
    return made_once(tmp_path_factory, "tiny", write_tiny_capture)


def write_tiny_capture(folder: Path) -> None:
    from dsar.body.files import load_body
    from dsar.data.motions.files import write_motion
    from dsar.raster import rasterize

    (folder / "motion").mkdir()
    body, rig = load_body(), cameras()
    sequences = {}
    for name, motion in motions().items():
        write_motion(folder / "motion" / f"{name}.npz", motion, body)
        for frame, gaussians in enumerate(speckled(body, motion)):
            for camera in rig:
                output = rasterize(gaussians, camera)
                straight = output.color / output.alpha[..., None].clamp_min(1e-3)
                pixels = torch.cat([straight, output.alpha[..., None]], -1).clamp(0, 1) * 255
                path = folder / "images" / name / camera.name / f"{frame:04d}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(pixels.round().byte().numpy(), "RGBA").save(path)
        sequences[name] = {
            "motion": f"motion/{name}.npz",
            "images": f"images/{name}",
            "frames": len(motion),
            "split": "test" if name == "bend" else "train",
            "labels": ["fd"] if name == "bend" else [],
        }
    description = {
        "format": "dsar-capture",
        "version": 1,
        "name": "tiny",
        "fps": 30.0,
        "cameras": [
            {
                "name": camera.name,
                "K": camera.K.tolist(),
                "T_camera_world": camera.T_camera_world.tolist(),
                "width": camera.width,
                "height": camera.height,
            }
            for camera in rig
        ],
        "body": None,
        "betas": [0.0] * 10,
        "sequences": sequences,
        "one_to_many": [],
    }
    (folder / "capture.json").write_text(json.dumps(description))


TINY = [
    *("--atlas.resolution", "32", "--atlas.garment", "off", "--model.channels", "8", "16"),
    *("--model.upsample", "2", "--model.heads", "2", "--model.window", "3", "--model.memory", "2"),
    *(
        "--schedule.max-rollout-frames",
        "4",
        "--schedule.rollouts-per-worker",
        "2",
        "--schedule.chunk-frames",
        "4",
        "--progress",
        "none",
    ),
]


def train_arguments(capture: Path, out: Path, *more: str) -> list[str]:
    """Return the arguments of a `dsar train` that takes seconds."""
    return ["train", str(capture), "--out", str(out), *TINY, *more]


@pytest.fixture(scope="session")
def trained(tiny_capture, tmp_path_factory) -> Path:
    """Return the run folder of an avatar of the tiny capture, trained by one worker.

    Each process has a copy of its own, because commands leave figures and reports in it.
    """
    from dsar.cli import main

    def train(folder: Path) -> None:
        figures = ("--json", str(folder / "train.json"))
        main(train_arguments(tiny_capture, folder / "tiny", "--steps", "120", "--workers", "1", *figures))

    made = made_once(tmp_path_factory, "trained", train)
    return shutil.copytree(made, tmp_path_factory.mktemp("runs"), dirs_exist_ok=True) / "tiny"


@pytest.fixture(scope="session")
def figure():
    """A coloured body that turns and bends, all of whose Gaussians change in every frame."""
    from dsar.avatar.avatar import Avatar
    from dsar.avatar.charts import Atlas, body_chart
    from dsar.avatar.rollout import roll_out
    from dsar.body.files import load_body
    from dsar.config import ModelConfig
    from dsar.types import Motion

    torch.manual_seed(0)
    config = ModelConfig(channels=(8, 16), heads=2, window=3, memory=2)
    avatar = Avatar(load_body(), Atlas.stack([body_chart(load_body(), 48)]), config, 24.0)
    torch.nn.init.normal_(avatar.network.decoder.head.weight, std=0.02)
    with torch.no_grad():
        # Red grows to the left hand, green to the head: what is mirrored or upside down shows.
        place = (avatar.texel_positions - avatar.texel_positions.amin(0)) / torch.tensor([1.8, 1.8, 1.0])
        place[:, 2] = 0.3
        avatar.template.harmonics.copy_(((place - 0.5) / 0.28209479)[:, None])
        avatar.template.opacity_logits.fill_(4.0)
    t = torch.arange(6) / 24
    rotations, translations = torch.zeros(6, 55, 3), torch.zeros(6, 3)
    rotations[:, 16, 2], rotations[:, 17, 2] = -0.8, 0.5
    rotations[:, 0, 1], rotations[:, 3, 0] = 0.4 + 2 * t, t
    translations[:, 0] = 0.5 * t
    return roll_out(avatar.eval(), Motion(rotations, translations, 24.0, "turn"), provenance={"run": "test"})


@pytest.fixture(scope="session")
def front():
    """A camera that sees all of the figure, with an off-centre principal point."""
    from dsar.geometry.cameras import look_at
    from dsar.types import Camera

    K = torch.tensor([[300.0, 0.0, 100.0], [0.0, 300.0, 130.0], [0.0, 0.0, 1.0]])
    return Camera(K, look_at(np.array([0.3, 0.2, 3.2]), np.array([0.0, -0.2, 0.0])), 192, 256, "front")
