"""The training loop: read it from top to bottom."""

import dataclasses
import logging
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import nn

from dsar.atomic_files import naming_storage_errors, write_text_atomically
from dsar.avatar.avatar import Avatar
from dsar.avatar.rest_frames import find_rest_frames
from dsar.config import TrainConfig, config_to_json, with_absolute_paths
from dsar.data.captures.formats import capture_of
from dsar.data.captures.multiview import MultiViewCapture
from dsar.errors import CaptureError, CheckpointError, ConfigError, TrainingError
from dsar.metrics.lpips import load_lpips
from dsar.training import checkpoint as ckpt
from dsar.training import workers
from dsar.training.budget import check_budget
from dsar.training.checkpoint import Run
from dsar.training.chunk import ChunkTrainer, UpdateMetrics
from dsar.training.optimizers import make_optimizers, set_rates
from dsar.training.registration import Registration
from dsar.training.report import REPORT_EVERY, Monitor, Reporter
from dsar.training.rest import RestOffsets
from dsar.training.scene import read_scene, scene_of_capture, write_scene
from dsar.training.schedule import ScheduleState, schedule_at
from dsar.types import Capture

_log = logging.getLogger(__name__)
SAVE_EVERY = 200
"""Updates between checkpoints (not seconds: all workers must agree)."""
STILL_FRAMES = 16
"""Near-rest frames that the template is fitted to."""
PROBE_EVERY = 100
"""Updates between comparisons of the losses' gradients, each of which costs as much as some updates."""


def train(config: TrainConfig, run: Run, *, resume: bool = False, report: Reporter | None = None) -> Run:
    """Train an avatar, or go on with a run; return the run, its checkpoint written.

    An interrupt (SIGINT) ends training after the current update with a checkpoint.

    Raises:
        DsarError: before any work, where settings, capture, body or run folder are not usable;
            TrainingError when a value stops being finite.
    """
    config.validate()
    if run.checkpoint.exists() and not resume:
        raise CheckpointError(f"{run.folder} holds a run already; go on with --resume, or give another --out")
    if resume and not run.checkpoint.exists():
        raise CheckpointError(f"{run.folder} holds no checkpoint to resume; leave --resume out")
    config = with_absolute_paths(config)
    if resume and config.body is None:
        # What came from the environment was written down, and the environment may be another now.
        config = dataclasses.replace(config, body=ckpt.read_config(run).body)
    whole = capture_of(config)
    capture = whole.with_cameras(config.cameras)
    if config.schedule.views > len(capture.cameras):
        raise ConfigError(
            f"schedule.views is {config.schedule.views}; there are {len(capture.cameras)} cameras"
        )
    config = with_body(config, capture)
    if resume:
        ckpt.check_files(run)
        check_same_settings(config, resumed_settings(run, config, whole), run)
    done = ckpt.read_progress(run)["progress"] if resume else 0.0
    check_budget(config, workers.local_count(config.workers), done, capture.kept_bytes)
    write_scene(run.scene, scene_of_capture(whole))
    write_text_atomically(run.config, config_to_json(config))
    workers.run_workers(config.workers, _train, (config, run.folder, resume), report)
    return run


def with_body(config: TrainConfig, capture: MultiViewCapture) -> TrainConfig:
    """Return the settings with the body file that came from the environment written down."""
    path = capture.body_path
    if config.body is not None or path is None or path.resolve().is_relative_to(capture.root.resolve()):
        return config
    return dataclasses.replace(config, body=str(path.resolve()))


def resumed_settings(run: Run, config: TrainConfig, capture: MultiViewCapture) -> TrainConfig:
    """Return the settings of a run; with the capture that is given now, if it is the same, moved."""
    saved = ckpt.read_config(run)
    if config.capture != saved.capture and run.scene.exists():
        if not read_scene(run.scene).is_of(scene_of_capture(capture)):
            return saved
        _log.info("Run %s: its capture was %s and is %s now", run.folder, saved.capture, config.capture)
        return dataclasses.replace(saved, capture=config.capture)
    return saved


def check_same_settings(config: TrainConfig, saved: TrainConfig, run: Run) -> None:
    """Raise ConfigError where a resumed run would change a setting other than its length."""
    length = {"steps": config.schedule.steps, "minutes": config.schedule.minutes}
    saved = dataclasses.replace(saved, schedule=dataclasses.replace(saved.schedule, **length))
    asked, had = dataclasses.asdict(config), dataclasses.asdict(saved)
    changed = sorted(key for key in asked if asked[key] != had[key])
    if changed:
        raise ConfigError(
            f"--resume: {run.config} was made with other values of {', '.join(changed)}; repeat the command "
            "that started the run, or start another with a new --out"
        )


def _train(config: TrainConfig, folder: Path, resume: bool, report: Reporter | None) -> None:
    torch.manual_seed(config.seed)
    run = Run(folder)
    capture = capture_of(config).with_cameras(config.cameras)
    if resume:
        avatar, _, _ = ckpt.load_checkpoint(run)
    else:
        avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model)
    lpips = load_lpips("alex") if config.loss.lpips else None
    trainer = ChunkTrainer(config, capture, avatar.train(), training_clips(capture), lpips)
    rest = RestOffsets(avatar, still_frames(trainer, avatar.fps))
    registration = Registration(config, capture, avatar, rest, trainer.signals, trainer.rollouts.clips)
    schedule = registration.reduced(config.schedule)
    optimizers = make_optimizers(avatar, rest, config.schedule)
    gradients = workers.Gradients([*avatar.parameters(), *rest.parameters()])
    step, progress = 0, 0.0
    if resume:
        at = ckpt.read_progress(run)
        step, progress = at["step"], at["progress"]
        ckpt.load_optimizers(optimizers, run.checkpoint)
        with ckpt.reading(run.checkpoint / f"rollouts-{workers.rank()}.safetensors"):
            trainer.load_state_dict(*ckpt.load_rollouts(run.checkpoint, workers.rank()))
        with ckpt.reading(run.checkpoint / f"registration-{workers.rank()}.safetensors"):
            registration.load_state_dict(ckpt.load_registration(run.checkpoint, workers.rank()))
        trainer.registered = registration.result
    clock, used, stop = Clock(schedule.minutes), 0.0, False
    monitor = Monitor(run.metrics, schedule.steps, report, began=progress)
    with _stop_signals() as received:
        while progress < 1:
            if stop:
                save(run, avatar, optimizers, trainer, registration, step, progress)
                _leave(received)
                return
            now = schedule_at(schedule, progress)
            if now.stage != "template" and not registration.complete:
                show = partial(monitor.show, step, progress, "registration")
                stop, used = _register(registration, gradients, received, clock, used, show)
                trainer.registered = registration.result
                continue
            set_rates(optimizers, now)
            rng = np.random.default_rng([config.seed, workers.rank(), step])
            gradients.clear()
            done = _backward(trainer, rest, rng, now, step)
            monitor.update(done)
            before, (stop, used) = used, gradients.average(bool(received), clock.used())
            if not gradients.buffer.isfinite().all():
                raise TrainingError(f"step {step}: the gradient of {bad_gradient(avatar)} is not finite")
            nn.utils.clip_grad_norm_(avatar.network.parameters(), config.schedule.max_gradient_norm)
            for optimizer in optimizers.values():
                optimizer.step()
            clock.start()
            step += 1
            progress = max(step / schedule.steps, progress + (used - before) * registration.schedule_speedup)
            if workers.rank() == 0 and (step % REPORT_EVERY == 0 or progress >= 1):
                monitor.write(step, progress, now.stage, clock.seconds())
            if progress >= 1 or step % SAVE_EVERY == 0:
                save(run, avatar, optimizers, trainer, registration, step, progress)


def _register(
    registration: Registration,
    gradients: workers.Gradients,
    received: list[int],
    clock: "Clock",
    before: float,
    show: Callable[[float, UpdateMetrics], None],
) -> tuple[bool, float]:
    """Fit the registered maps; return whether a stop came before the last, and the time used so far.

    `before` is the time used when they were begun.
    """
    # Clocks differ by a little, but all workers must agree: only numbers that they share count.
    began = registration.budget_used - before
    registration.avatar.unhide_covered_texels()
    stop, used = False, 0.0
    while not (stop or registration.complete):
        done = registration.fit_next()
        gradients.clear()
        stop, used = gradients.average(bool(received), clock.used())
        registration.budget_used = began + used
        if done is not None and registration.count % REPORT_EVERY == 0:
            show(clock.seconds(), done)
    if registration.complete:
        registration.all_gather()
    return stop, used


def _backward(
    trainer: ChunkTrainer,
    rest: RestOffsets,
    rng: np.random.Generator,
    now: ScheduleState,
    step: int,
) -> UpdateMetrics:
    """Compute the gradients of one update."""
    try:
        if now.stage == "template":
            return trainer.backward_template(rng, rest, now.reduction)
        if now.stage == "pretraining":
            return trainer.backward_pretraining(rng)
        return trainer.backward_chunk(rng, now, probe=workers.rank() == 0 and step % PROBE_EVERY == 0)
    except TrainingError as error:
        raise TrainingError(f"step {step} ({now.stage}): {error}") from error


def training_clips(capture: Capture) -> dict[str, range]:
    """Return the frames of each training sequence.

    Raises:
        CaptureError: no camera saw any of them.
    """
    clips = {name: range(len(capture.motions[name])) for name in capture.splits["train"]}
    if not any(capture.cameras_with_image(name, frame) for name, clip in clips.items() for frame in clip):
        raise CaptureError(f"capture {capture.name}: no camera has an image of a training frame")
    return clips


def still_frames(trainer: ChunkTrainer, fps: float) -> list[tuple[str, int]]:
    """Return the near-rest training frames that the template is fitted to."""
    clips = trainer.rollouts.clips
    transforms = {name: trainer.signals[name].transforms[: clip.stop] for name, clip in clips.items()}
    per_sequence = max(1, -(-STILL_FRAMES // len(clips)))
    return find_rest_frames(
        transforms, fps, STILL_FRAMES, per_sequence, trainer.loader.capture.cameras_with_image
    )


def bad_gradient(avatar: Avatar) -> str:
    """Return the name of the first parameter whose gradient is not finite."""
    named = avatar.named_parameters()
    bad = (name for name, p in named if p.grad is not None and not p.grad.isfinite().all())
    return next(bad, "the still frames' offsets")


def save(
    run: Run,
    avatar: Avatar,
    optimizers: Mapping[str, torch.optim.Optimizer],
    trainer: ChunkTrainer,
    registration: Registration,
    step: int,
    progress: float,
) -> None:
    """Write a complete checkpoint, every worker its own rollouts, and put it in place at once.

    Raises:
        StorageError: the system does not take it; the checkpoint before it stays.
    """
    folder = run.folder / "checkpoint.tmp"
    with naming_storage_errors(run.checkpoint), _removed_on_failure(folder):
        if workers.rank() == 0:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            ckpt.save_avatar(avatar, folder)
            ckpt.save_optimizers(optimizers, folder)
        workers.barrier()
        ckpt.save_rollouts(folder, workers.rank(), *trainer.state_dict())
        ckpt.save_registration(folder, workers.rank(), registration.state_dict())
        workers.barrier()
        if workers.rank() == 0:
            ckpt.save_progress(folder, step, progress, run)
            ckpt.replace_folder(folder, run.checkpoint)
        workers.barrier()


@contextmanager
def _removed_on_failure(folder: Path) -> Iterator[None]:
    """Give back the room that half a checkpoint takes."""
    try:
        yield
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


class Clock:
    """The time since the first update, which compiles kernels where they never ran before."""

    def __init__(self, minutes: float | None) -> None:
        self.minutes = minutes
        self.began: float | None = None

    def start(self) -> None:
        """Begin to count, unless it has begun."""
        self.began = self.began if self.began is not None else time.monotonic()

    def seconds(self) -> float:
        """Return the seconds counted."""
        return 0.0 if self.began is None else time.monotonic() - self.began

    def used(self) -> float:
        """Return the share of the budget used; 0 without a budget."""
        return 0.0 if self.minutes is None else self.seconds() / (60 * self.minutes)


@contextmanager
def _stop_signals() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM in the first worker; the others follow it and ignore the keyboard."""
    received: list[int] = []
    first = workers.rank() == 0

    def note(number: int, _frame: object) -> None:
        if first:
            received.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _leave(received: list[int]) -> None:
    """End training in the way that the signal asks for."""
    if signal.SIGTERM in received:
        raise SystemExit(128 + signal.SIGTERM)
    if received:
        raise KeyboardInterrupt
