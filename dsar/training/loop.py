"""The training loop: read it from top to bottom."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import nn

from dsar.atomic_files import write_text_atomically
from dsar.avatar.avatar import Avatar
from dsar.avatar.driving import DrivingSignal
from dsar.avatar.rest_frames import find_rest_frames
from dsar.config import TrainConfig, config_to_json, with_absolute_paths
from dsar.data.captures.formats import capture_of
from dsar.errors import CaptureError, CheckpointError, ConfigError, TrainingError
from dsar.metrics.lpips import load_lpips
from dsar.training import launch, workers
from dsar.training.budget import Room, check_budget
from dsar.training.checkpoint import Run, check_files, load_checkpoint, read_config, read_progress
from dsar.training.chunk import ChunkTrainer
from dsar.training.kept_views import KeptViews, kept_bytes, largest_crop
from dsar.training.layers import Layers
from dsar.training.optimizers import keep_still, set_rates
from dsar.training.pace import Clock, leave, stop_signals
from dsar.training.prior_fitting import fit_prior
from dsar.training.registration import Registration
from dsar.training.report import REPORT_EVERY, Monitor, Reporter, UpdateMetrics, warn_if_cut_short
from dsar.training.resuming import (
    check_same_settings,
    divide_anew,
    resumed_settings,
    with_body,
    with_former_defaults,
)
from dsar.training.scene import scene_of_capture, write_scene
from dsar.training.schedule import ScheduleState, schedule_at, without_pretraining
from dsar.training.state import TrainingState
from dsar.training.state_files import read_checkpoint, write_checkpoint
from dsar.training.targets import MARGIN
from dsar.training.time_limit import TimeLimit, part_at
from dsar.types import Capture

SAVE_EVERY = 200
"""Updates between checkpoints (not seconds: all workers must agree)."""
STILL_FRAMES = 16
"""Near-rest frames that the template is fitted to."""
PROBE_EVERY = 100
"""Updates between comparisons of the losses' gradients, each of which costs as much as some updates."""


def train(
    config: TrainConfig,
    run: Run,
    *,
    resume: bool = False,
    report: Reporter | None = None,
    device: torch.device | str = "cpu",
) -> Run:
    """Train an avatar, or go on with a run; return the run, its checkpoint written.

    An interrupt (SIGINT) ends training after the current update with a checkpoint.

    Args:
        config: The settings of the run.
        run: Its folder.
        resume: Whether to go on with it, on whatever devices and by how many workers it was trained so far.
        report: Is told of progress.
        device: Where to compute.

    Where torchrun started several ranks all call this: they are the workers, and the first one writes.

    Raises:
        DsarError: before any work, where settings, capture, body or run folder are not usable;
            TrainingError when a value stops being finite.
    """
    device = torch.device(device)
    config = dataclasses.replace(config, workers=workers.total_count(config.workers))
    with launch.joined(device):
        divided, seconds = launch.from_first(partial(_prepare, config, run, device, resume=resume))
        workers.run_workers(divided.workers, _train, (divided, run.folder, resume, seconds, device), report)
    return run


def _prepare(
    config: TrainConfig, run: Run, device: torch.device, *, resume: bool
) -> tuple[TrainConfig, float]:
    """Check all that is asked for, and write down the settings and the scene of the run.

    Returns:
        The settings for the workers that there are, with what they recompute decided, and the seconds that an
        update's network takes at least.
    """
    config.validate()
    if run.checkpoint.exists() and not resume:
        raise CheckpointError(f"{run.folder} holds a run already; go on with --resume, or give another --out")
    if resume and not run.checkpoint.exists():
        raise CheckpointError(f"{run.folder} holds no checkpoint to resume; leave --resume out")
    config = with_absolute_paths(config)
    if resume and config.body is None:
        # What came from the environment was written down, and the environment may be another now.
        config = dataclasses.replace(config, body=read_config(run).body)
    whole = capture_of(config)
    capture = whole.with_cameras(config.cameras)
    if config.schedule.views > len(capture.cameras):
        raise ConfigError(
            f"schedule.views is {config.schedule.views}; there are {len(capture.cameras)} cameras"
        )
    config = with_body(config, capture)
    if resume:
        check_files(run)
        saved = resumed_settings(run, config, whole)
        config = with_former_defaults(config, saved)
        check_same_settings(config, saved, run)
        config, divided = dataclasses.replace(config, workers=saved.workers), divide_anew(config, saved)
    else:
        divided = config
    done = read_progress(run).progress if resume else 0.0
    images, view = capture.kept_bytes + kept_bytes(capture), largest_crop(capture, MARGIN)
    sharing = 1 if device.type == "cuda" and launch.launched() else workers.local_count(divided.workers)
    budget = check_budget(divided, Room(device, sharing, images, view), done)
    write_scene(run.scene, scene_of_capture(whole))
    write_text_atomically(run.config, config_to_json(config))
    return budget.config, budget.network_seconds


def _train(
    config: TrainConfig,
    folder: Path,
    resume: bool,
    network_seconds: float,
    device: torch.device,
    report: Reporter | None,
) -> None:
    """Train in one worker, from the capture to the last checkpoint."""
    torch.manual_seed(config.seed)
    run, capture = Run(folder), capture_of(config).with_cameras(config.cameras)
    if resume:
        avatar, _, _ = load_checkpoint(run, device)
    else:
        avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model).to(device)
    avatar.network.recomputes = config.schedule.recomputation == "on"
    lpips = load_lpips("alex").to(device) if config.loss.lpips else None
    clips = training_clips(capture)
    signals = {name: avatar.driving_signal(capture.motions[name]) for name in clips}
    still = rest_frames(capture, signals, clips, avatar.fps)
    state = TrainingState.begin(config, capture, avatar.train(), clips, still)
    views = KeptViews(capture)
    trainer = ChunkTrainer(config, views, state, signals, lpips)
    registration = Registration(config, views, avatar, state.rest, state.registered, signals)
    layers = Layers(views, avatar, state.registered, signals, clips)

    def settle_layers() -> None:
        layers.settle()
        keep_still(state.optimizers, avatar)

    gradients = workers.Gradients([*avatar.parameters(), *state.rest.parameters()])
    if resume:
        read_checkpoint(run, state)
    schedule = config.schedule if state.registered.clips else without_pretraining(config.schedule)
    limit = TimeLimit(schedule, state.seconds, workers.mean(network_seconds))
    clock, stop, dressed = Clock(), False, False
    monitor = Monitor(run.metrics, schedule.steps, report, began=state.progress)
    with stop_signals() as received:
        while state.progress < 1:
            if stop:
                write_checkpoint(run, state)
                leave(received)
                return
            schedule_state = schedule_at(schedule, state.progress)
            if schedule_state.stage != "template" and not state.registered.complete:
                show = partial(monitor.show, state.step, state.progress, "registration")
                stop = _register(registration, gradients, received, clock, limit, state.progress, show)
                state.seconds = limit.seconds
                if state.registered.complete:
                    settle_layers()
                continue
            if schedule_state.stage != "template" and not dressed:
                if avatar.texel_hidden.any():
                    settle_layers()
                if avatar.prior is not None and not avatar.prior.placed:
                    fit_prior(avatar, state.registered, signals, still, config.seed)
                    signals = {name: avatar.with_cloth(signal) for name, signal in signals.items()}
                    avatar.fit_input_statistics(list(signals.values()))
                    trainer.drive(signals)
                # Asked once, for the answers make the host wait for a GPU.
                dressed = True
            set_rates(state.optimizers, schedule_state)
            rng = np.random.default_rng([config.seed, workers.rank(), state.step])
            gradients.clear()
            metrics = _backward(trainer, rng, schedule_state, state.step)
            monitor.update(metrics)
            stop, seconds = gradients.average(bool(received), clock.seconds())
            if not gradients.buffer.isfinite().all():
                bad = _bad_gradient(avatar)
                raise TrainingError(f"step {state.step}: the gradient of {bad} is not finite")
            nn.utils.clip_grad_norm_(avatar.network.parameters(), config.schedule.max_gradient_norm)
            for optimizer in state.optimizers.values():
                optimizer.step()
            clock.start()
            limit.note(part_at(schedule, state.progress), seconds)
            state.seconds = limit.seconds
            state.advance(schedule.steps, limit.passes_over(state.progress, state.registered.frames_left))
            if workers.rank() == 0 and (state.step % REPORT_EVERY == 0 or state.progress >= 1):
                monitor.write(state.step, state.progress, schedule_state.stage, clock.seconds(), state.cut)
            if state.progress >= 1 or state.step % SAVE_EVERY == 0:
                write_checkpoint(run, state)
    if workers.rank() == 0:
        warn_if_cut_short(state.step, state.cut, schedule.minutes)


def _register(
    registration: Registration,
    gradients: workers.Gradients,
    received: list[int],
    clock: Clock,
    limit: TimeLimit,
    progress: float,
    show: Callable[[float, UpdateMetrics], None],
) -> bool:
    """Fit the registered maps; return whether a stop came before the last."""
    # Clocks differ by a little, but all workers must agree: only numbers that they share count.
    maps, stop, late = registration.maps, False, False
    registration.avatar.unhide_covered_texels()
    while not (stop or late or maps.complete):
        metrics = registration.fit_next()
        gradients.clear()
        stop, seconds = gradients.average(bool(received), clock.seconds())
        limit.note("registration", seconds)
        late = limit.ends_registration(progress, maps.frames_left)
        if metrics is not None and maps.count % REPORT_EVERY == 0:
            show(clock.seconds(), metrics)
    if late or maps.complete:
        maps.all_gather()
    return stop


def _backward(
    trainer: ChunkTrainer, rng: np.random.Generator, schedule_state: ScheduleState, step: int
) -> UpdateMetrics:
    """Compute the gradients of one update."""
    try:
        if schedule_state.stage == "template":
            return trainer.backward_template(rng, schedule_state.reduction)
        if schedule_state.stage == "pretraining":
            return trainer.backward_pretraining(rng)
        return trainer.backward_chunk(
            rng, schedule_state, probe=workers.rank() == 0 and step % PROBE_EVERY == 0
        )
    except TrainingError as error:
        raise TrainingError(f"step {step} ({schedule_state.stage}): {error}") from error


def training_clips(capture: Capture) -> dict[str, range]:
    """Return the frames of each training sequence.

    Raises:
        CaptureError: no camera saw any of them.
    """
    clips = {name: range(len(capture.motions[name])) for name in capture.splits["train"]}
    if not any(capture.cameras_with_image(name, frame) for name, clip in clips.items() for frame in clip):
        raise CaptureError(f"capture {capture.name}: no camera has an image of a training frame")
    return clips


def rest_frames(
    capture: Capture,
    signals: Mapping[str, DrivingSignal],
    clips: Mapping[str, range],
    fps: float,
) -> list[tuple[str, int]]:
    """Return sequence and frame of the near-rest training frames that the template is fitted to."""
    transforms = {name: signals[name].transforms[: clip.stop] for name, clip in clips.items()}
    per_sequence = max(1, -(-STILL_FRAMES // len(clips)))
    return find_rest_frames(transforms, fps, STILL_FRAMES, per_sequence, capture.cameras_with_image)


def _bad_gradient(avatar: Avatar) -> str:
    """Return the name of the first parameter whose gradient is not finite."""
    named = avatar.named_parameters()
    bad = (name for name, p in named if p.grad is not None and not p.grad.isfinite().all())
    return next(bad, "the still frames' offsets")
