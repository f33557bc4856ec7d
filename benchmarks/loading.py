"""Does decoding images stall training? Photographs of a real size, read ahead or when they are needed.

    python benchmarks/loading.py --json benchmarks/results/loading.json

Some frames of the embedded capture are enlarged to AvatarReX's size and written in its layout, JPEG masks and
lens distortion included. Nothing is kept in memory: every view is read, decoded and undistorted anew.
"""

import argparse
import dataclasses
import json
import statistics
import tempfile
import time
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import torch
from machine import describe_machine, read_load
from PIL import Image
from results import write_json

from dsar.avatar.avatar import Avatar
from dsar.body.files import EMBEDDED_BODY
from dsar.config import PRESETS
from dsar.data.captures.formats import open_capture
from dsar.data.captures.multiview import MultiViewCapture
from dsar.data.images import decoding
from dsar.training.chunk import ChunkTrainer
from dsar.training.draws import Draws
from dsar.training.kept_views import KeptViews
from dsar.training.loop import training_clips
from dsar.training.schedule import schedule_at
from dsar.training.state import TrainingState
from dsar.training.targets import Target, TargetLoader, load_target

SEQUENCE, SCALE = "sway", 8
DISTORTION = [-0.08, 0.02, 0.0005, -0.0005, 0.0]
LATE = 0.9
"""Progress at which updates render at full resolution and roll out whole clips."""


class AtOnce(TargetLoader):
    """Loads a view when it is asked for, in the caller's thread."""

    def request(self, rng, sequence, frame, reduction, count):
        """Load views and return them."""
        return [
            _done(load_target(self.views, sequence, frame, int(k), reduction))
            for k in _draw(self, rng, sequence, frame, count)
        ]


class Timed(TargetLoader):
    """Loads ahead, and adds up how long the network waited for it."""

    waited = 0.0

    def request(self, rng, sequence, frame, reduction, count):
        """Begin to load; the caller's wait is counted when it asks for a result."""
        return [_Waiting(self, each) for each in super().request(rng, sequence, frame, reduction, count)]


class _Waiting(Future):
    def __init__(self, loader: Timed, future: Future) -> None:
        super().__init__()
        self.loader, self.future = loader, future

    def result(self, timeout: float | None = None) -> Target:
        began = time.perf_counter()
        target = self.future.result(timeout)
        self.loader.waited += time.perf_counter() - began
        return target


def _draw(
    loader: TargetLoader, rng: np.random.Generator, sequence: str, frame: int, count: int
) -> np.ndarray:
    seen = loader.views.capture.cameras_with_image(sequence, frame)
    return rng.choice(seen, min(count, len(seen)), replace=False)


def _done(target: Target) -> Future:
    future: Future = Future()
    future.set_result(target)
    return future


def write_large(folder: Path, frames: int, cameras: int) -> None:
    """Write some frames of the embedded capture, enlarged, in AvatarReX's layout."""
    capture = open_capture().with_cameras(cameras)
    motion = capture.motions[SEQUENCE].slice(0, frames)
    record = {}
    for index, camera in enumerate(capture.cameras):
        size = SCALE * camera.width, SCALE * camera.height
        large = camera.resized(*size)
        K = large.K.double()
        K[:2, 2] -= 0.5
        record[camera.name] = {
            "K": K.flatten().tolist(),
            "R": camera.T_camera_world[:3, :3].flatten().tolist(),
            "T": camera.T_camera_world[:3, 3].tolist(),
            "distCoeff": DISTORTION,
            "imgSize": list(size),
        }
        for frame in range(frames):
            image = Image.fromarray(capture.image(SEQUENCE, frame, index)).resize(
                size, Image.Resampling.BICUBIC
            )
            for path, picture in (("", image.convert("RGB")), ("mask/pha", image.getchannel("A"))):
                where = folder / camera.name / path / f"{frame:08d}.jpg"
                where.parent.mkdir(parents=True, exist_ok=True)
                picture.save(where, quality=95)
    (folder / "calibration_full.json").write_text(json.dumps(record))
    rotations = motion.rotations.numpy()
    np.savez(
        folder / "smpl_params.npz",
        betas=np.zeros((1, 10)),
        global_orient=rotations[:, 0],
        body_pose=rotations[:, 1:22].reshape(frames, -1),
        transl=motion.translations.numpy(),
    )


def measure(capture: MultiViewCapture, updates: int) -> dict:
    """Return seconds an update with views loaded at once and ahead, in turn, and what loading costs."""
    torch.manual_seed(0)
    config = PRESETS["demo"]
    config = dataclasses.replace(config, atlas=dataclasses.replace(config.atlas, garment="off"))
    avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model)
    clips = training_clips(capture)
    state = TrainingState.begin(config, capture, avatar.train(), clips, [])
    signals = {name: avatar.driving_signal(capture.motions[name]) for name in clips}
    # No room: what a capture larger than memory comes to.
    kept = KeptViews(capture, 0)
    trainer = ChunkTrainer(config, kept, state, signals, None)
    now, ahead = schedule_at(config.schedule, LATE), Timed(kept)
    seconds: dict[str, list[float]] = {"at_once": [], "ahead": []}
    for update in range(-2, updates):
        for name, loader in (("at_once", AtOnce(kept)), ("ahead", ahead)):
            trainer.loader = loader
            draws = Draws(0, update + 2)
            avatar.zero_grad()
            began = time.perf_counter()
            trainer.backward_chunk(draws, now)
            if update >= 0:
                seconds[name].append(time.perf_counter() - began)
            elif name == "ahead":
                ahead.waited = 0.0
    sequence = capture.splits["train"][0]
    views = [(sequence, frame, index) for frame in range(4) for index in range(len(capture.cameras))]
    began = time.perf_counter()
    for view in views:
        load_target(kept, *view, now.reduction)
    medians = {name: statistics.median(each) for name, each in seconds.items()}
    return {
        "seconds": medians,
        "waiting_share": ahead.waited / sum(seconds["ahead"]),
        "load_ms": 1e3 * (time.perf_counter() - began) / len(views),
        "reduction": now.reduction,
        "kept_bytes": decoding.CACHE.used,
    }


def main() -> None:
    """Measure, print, and write what was found."""
    parser = argparse.ArgumentParser(description="Does decoding images stall training?")
    parser.add_argument("--quick", action="store_true", help="fewer updates, under a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    frames, cameras, updates = (8, 2, 3) if arguments.quick else (24, 4, 12)
    # So that every view is read: what a capture larger than memory comes to.
    decoding.CACHE.capacity = 0
    with tempfile.TemporaryDirectory() as folder:
        write_large(Path(folder) / "take", frames, cameras)
        ranges = {"train_frames": f"0-{frames - 3}", "test_frames": f"{frames - 2}-{frames - 1}"}
        capture = open_capture(Path(folder) / "take", body=EMBEDDED_BODY, **ranges)
        found = measure(capture, updates)
    size = capture.cameras[0].width, capture.cameras[0].height
    found |= {"size": size, "updates": updates, "machine": describe_machine(), "load": read_load()}
    print(json.dumps(found, indent=1))
    if arguments.json:
        write_json(found, arguments.json)
    waited = f"{found['waiting_share']:.0%} of the time is spent waiting for images"
    print(f"loading a view of {size[0]}x{size[1]}: {found['load_ms']:.0f} ms; {waited}")
    ratio = found["seconds"]["at_once"] / found["seconds"]["ahead"]
    print(f"an update that loads ahead is {ratio:.2f} times as fast as one that loads when it needs to")


if __name__ == "__main__":
    main()
