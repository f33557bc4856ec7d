"""The GPU benchmark's training: updates a second by stage, what an update consists of, and its memory."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from gpu_memory import forget_peak, read_peak
from gpu_network import settings
from timing import Timing, time_once, time_runs
from torch import nn
from torch.profiler import ProfilerActivity, profile

from dsar.avatar.avatar import Avatar
from dsar.config import TrainConfig
from dsar.data.captures.formats import open_capture
from dsar.data.captures.multiview import MultiViewCapture
from dsar.devices import choose_device
from dsar.evaluation.profiling import read_clock
from dsar.metrics.lpips import Lpips
from dsar.training.chunk import ChunkTrainer
from dsar.training.draws import Draws
from dsar.training.kept_views import KeptViews
from dsar.training.loop import rest_frames, training_clips
from dsar.training.optimizers import set_rates
from dsar.training.registration import Registration
from dsar.training.schedule import schedule_at
from dsar.training.state import TrainingState
from dsar.training.workers import Gradients

SEQUENCES = ("spin_jump", "walk")
"""Training sequences; others do not travel with the packed benchmark."""
FRAMES, QUICK_FRAMES = 48, 4
WIDTHS = {"demo": 192, "paper": 960}
"""Pixels across an image, which is 4/3 as high: the embedded capture's own, and five times as many."""
QUICK_WIDTH = 96
OPERATORS = 12
"""Operators that a profile names."""
STAGES = (0.03, 0.2, 0.35, 0.95)
"""Places in the schedule that have different stages, in any preset."""


class FewerPixels:
    """A sequence's images with one of many pixels."""

    def __init__(self, views: Any, step: int) -> None:
        self.views, self.has, self.step = views, views.has, step

    def read(self, camera: Any, frame: int) -> np.ndarray:
        """Return an image of as many times fewer pixels each way."""
        whole = camera.resized(camera.width * self.step, camera.height * self.step)
        return self.views.read(whole, frame)[:: self.step, :: self.step].copy()


class LargeViews:
    """A sequence's images with each pixel repeated."""

    def __init__(self, views: Any, factor: int) -> None:
        self.views, self.has, self.factor = views, views.has, factor

    def read(self, camera: Any, frame: int) -> np.ndarray:
        """Return an image of as many times the pixels."""
        small = camera.resized(camera.width // self.factor, camera.height // self.factor)
        image = self.views.read(small, frame)
        return image.repeat(self.factor, 0).repeat(self.factor, 1)


@cache
def open_part(frames: int, width: int) -> MultiViewCapture:
    """Return the first frames of some sequences of the embedded capture, in images of another width."""
    capture = open_capture(train_frames=f"0-{frames - 1}")
    whole = capture.cameras[0].width
    resize = partial(FewerPixels, step=whole // width)
    if width > whole:
        resize = partial(LargeViews, factor=width // whole)
    return dataclasses.replace(
        capture,
        cameras=[c.resized(width, c.height * width // c.width) for c in capture.cameras],
        motions={name: capture.motions[name] for name in SEQUENCES},
        splits={"train": SEQUENCES, "test": (), "fd": ()},
        views={name: resize(capture.views[name]) for name in SEQUENCES},
        garments={name: capture.garments[name] for name in SEQUENCES},
        one_to_many=(),
    )


class Updates:
    """A worker's updates, as `dsar.training.loop` does them, at any place of the schedule."""

    def __init__(self, config: TrainConfig, capture: MultiViewCapture, device: torch.device) -> None:
        torch.manual_seed(0)
        avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model).to(device).train()
        clips = training_clips(capture)
        # The constants of the cloth stay the first guess, for the search for better ones takes minutes.
        avatar.place_prior()
        signals = {name: avatar.driving_signal(capture.motions[name]) for name in clips}
        still = rest_frames(capture, signals, clips, avatar.fps)
        self.config, self.views = config, KeptViews(capture)
        self.state = state = TrainingState.begin(config, capture, avatar, clips, still)
        # Random weights of its own: trained ones do not travel, and take as long.
        lpips = Lpips("alex").to(device).eval() if config.loss.lpips else None
        self.trainer = ChunkTrainer(config, self.views, state, signals, lpips)
        self.registration = Registration(config, self.views, avatar, state.rest, state.registered, signals)
        self.gradients = Gradients([*avatar.parameters(), *state.rest.parameters()])
        for name, clip in state.registered.clips.items():
            state.registered.fitted[name] = torch.tensor(len(clip))

    def update(self, progress: float) -> None:
        """Do one update of the stage that is due at a place of the schedule."""
        state, now = self.state, schedule_at(self.config.schedule, progress)
        set_rates(state.optimizers, now)
        draws = Draws(0, state.step)
        self.gradients.clear()
        if now.stage == "template":
            self.trainer.backward_template(draws, now.reduction)
        elif now.stage == "pretraining":
            self.trainer.backward_pretraining(draws)
        else:
            self.trainer.backward_chunk(draws, now)
        nn.utils.clip_grad_norm_(state.avatar.network.parameters(), self.config.schedule.max_gradient_norm)
        for optimizer in state.optimizers.values():
            optimizer.step()
        state.step += 1

    def stages(self) -> dict[str, Callable[[], object]]:
        """Return what does one update of each stage of the schedule, by name, in their order."""
        found: dict[str, Callable[[], object]] = {}
        for progress in STAGES:
            stage = schedule_at(self.config.schedule, progress).stage
            found.setdefault(stage, partial(self.update, progress))
        if self.state.registered.clips:
            found["registration"] = self.registration.fit_next
        return found


def measure_training(
    quick: bool, device: str, presets: tuple[str, ...] = ("demo", "paper")
) -> Iterator[dict]:
    """Yield updates a second, memory and a profile, by preset and stage."""
    where, frames = choose_device(device), QUICK_FRAMES if quick else FRAMES
    for preset in presets:
        config = settings(preset, quick)
        if quick:
            rollouts = min(2, config.schedule.rollouts_per_worker)
            schedule = dataclasses.replace(config.schedule, rollouts_per_worker=rollouts, chunk_frames=2)
            config = dataclasses.replace(config, schedule=schedule)
        capture = open_part(frames, QUICK_WIDTH if quick else WIDTHS[preset])
        updates = Updates(config, capture, where)
        stages = updates.stages()
        if quick and preset == "paper":
            # Its stages differ in their place in the schedule alone.
            stages = {"autoregressive": stages["autoregressive"]}
        for stage, work in stages.items():
            same = {"preset": preset, "stage": stage, "device": where.type, "skipped": None}
            for _ in range(0 if quick else 3):
                work()
            forget_peak()
            finish = partial(_finish, work)
            timing = _time_first(finish) if quick else time_runs(finish, 5.0, 60)
            rate = {"updates_per_s": 1e3 / timing.median_ms, "peak_bytes": read_peak()}
            # Reading a profile takes longer than a tiny update: one is enough to keep it alive.
            repeats = 2 if not quick else int(preset == "paper")
            taken_apart = profile_work(work, where, repeats) if repeats else {}
            yield same | asdict(timing) | rate | taken_apart


def measure_cpu_training(quick: bool, device: str) -> Iterator[dict]:
    """Yield the demo's updates on this machine's CPU, with one thread, to hold the GPU's against."""
    if choose_device(device).type == "cpu":
        yield {"stage": "all", "skipped": "training was measured on the CPU already"}
        return
    torch.set_num_threads(1)
    yield from measure_training(quick, "cpu", ("demo",))


def profile_work(work: Callable[[], object], device: torch.device, repeats: int) -> dict:
    """Return how many operators an update has, how long the GPU was busy, and which took longest."""
    activities = [ProfilerActivity.CPU]
    if device.type == "cuda":
        activities.append(ProfilerActivity.CUDA)
    start = read_clock()
    with profile(activities=activities) as profiler:
        for _ in range(repeats):
            work()
        seconds = read_clock() - start
    rows = [
        {
            "name": event.key,
            "calls": event.count / repeats,
            "device_ms": 1e-3 * event.self_device_time_total / repeats,
            "host_ms": 1e-3 * event.self_cpu_time_total / repeats,
        }
        for event in profiler.key_averages()
    ]
    key = "device_ms" if device.type == "cuda" else "host_ms"
    rows.sort(key=lambda row: -row[key])
    busy = sum(row["device_ms"] for row in rows)
    return {
        "operators": sum(row["calls"] for row in rows if row["name"].startswith("aten::")),
        "busy_ms": busy if device.type == "cuda" else None,
        "profiled_ms": 1e3 * seconds / repeats,
        "longest": rows[:OPERATORS],
    }


def _time_first(work: Callable[[], object]) -> Timing:
    """Return what a first run takes, compilation included."""
    milliseconds = 1e3 * time_once(work)
    return Timing(milliseconds, milliseconds, milliseconds, 1)


def _finish(work: Callable[[], object]) -> None:
    """Update, and wait for the GPU."""
    work()
    read_clock()
