"""A run of the embedded capture so small that a rasteriser in plain torch trains it in seconds."""

import dataclasses
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from unittest.mock import patch

import torch

from dsar.config import TrainConfig
from dsar.data.captures.formats import open_capture
from dsar.data.captures.multiview import MultiViewCapture
from dsar.training import loop
from dsar.training.checkpoint import Run
from dsar.training.report import Report

TRAIN, TEST = "spin_jump", "far"
STEPS = 8
_FRAMES = 4
_COARSER = 4
"""Images are as many times smaller each way than the capture's."""


class _CoarseViews:
    """A sequence's images with one of many pixels."""

    def __init__(self, views) -> None:
        self.views, self.has = views, views.has

    def read(self, camera, frame):
        whole = camera.resized(_COARSER * camera.width, _COARSER * camera.height)
        return self.views.read(whole, frame)[::_COARSER, ::_COARSER].copy()


@cache
def small_capture() -> MultiViewCapture:
    """Return four frames of a training and of a test sequence, in images of 48 x 64 pixels."""
    capture = open_capture("embedded", train_frames=f"0-{_FRAMES - 1}", test_frames=f"0-{_FRAMES - 1}")
    cameras = [c.resized(c.width // _COARSER, c.height // _COARSER) for c in capture.cameras]
    return dataclasses.replace(
        capture,
        cameras=cameras,
        motions={name: capture.motions[name] for name in (TRAIN, TEST)},
        splits={"train": (TRAIN,), "test": (TEST,), "fd": (TEST,)},
        views={name: _CoarseViews(capture.views[name]) for name in (TRAIN, TEST)},
        garments={name: capture.garments[name] for name in (TRAIN, TEST)},
        one_to_many=(),
    )


def small_config() -> TrainConfig:
    """Return settings with which the run goes through every stage, and uses all that the default uses."""
    config = TrainConfig(workers=1)
    return dataclasses.replace(
        config,
        atlas=dataclasses.replace(config.atlas, resolution=32, garment_rows=16),
        model=dataclasses.replace(config.model, channels=(4, 8), heads=2, window=3, memory=2, upsample=4),
        schedule=dataclasses.replace(
            config.schedule,
            steps=STEPS,
            template_fraction=0.25,
            pretraining_fraction=0.25,
            pose_only_fraction=0.25,
            rollouts_per_worker=2,
            chunk_frames=2,
        ),
    )


def default_config() -> TrainConfig:
    """Return the default settings of network, losses and batch, with narrow maps and as few updates."""
    small, config = small_config(), TrainConfig(workers=1)
    return dataclasses.replace(
        config,
        atlas=small.atlas,
        model=dataclasses.replace(config.model, channels=(4, 4, 8), heads=2, upsample=4),
        schedule=dataclasses.replace(
            config.schedule, steps=STEPS, template_fraction=0.25, pretraining_fraction=0.25
        ),
    )


@contextmanager
def few_of_everything() -> Iterator[None]:
    """Have training do less of all that it does many times, and report every update."""
    few = {
        "loop.REPORT_EVERY": 1,
        "chunk.TEMPLATE_FRAMES": 2,
        "registration.STEPS": 2,
        "prior_fitting.GENERATIONS": 1,
        "prior_fitting.POPULATION": 4,
        "layers.FRAMES": 2,
    }
    with ExitStack() as stack:
        stack.enter_context(patch.object(loop, "capture_of", lambda _: small_capture()))
        for name, value in few.items():
            stack.enter_context(patch(f"dsar.training.{name}", value))
        yield


def train_small(
    folder: Path,
    device: torch.device | str,
    report: Callable[[Report], None] = lambda _: None,
    *,
    stop_after: int = STEPS,
    resume: bool = False,
    config: TrainConfig | None = None,
) -> Run:
    """Train the small run, or one of other settings, up to an update; return its folder."""

    def listen(line: Report) -> None:
        report(line)
        if line.step == stop_after < STEPS and line.stage != "registration":
            signal.raise_signal(signal.SIGINT)

    with few_of_everything():
        try:
            return loop.train(
                config or small_config(), Run(folder), resume=resume, report=listen, device=device
            )
        except KeyboardInterrupt:
            return Run(folder)
