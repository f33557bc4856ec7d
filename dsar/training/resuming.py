"""The settings with which a run may go on: its own, but for its length, its places and its workers."""

import dataclasses
import logging

from dsar.config import PRESETS, TrainConfig
from dsar.config.migrations import FORMER_DEFAULTS
from dsar.data.captures.multiview import MultiViewCapture
from dsar.errors import ConfigError
from dsar.training.checkpoint import Run, read_config
from dsar.training.scene import read_scene, scene_of_capture

_log = logging.getLogger(__name__)


def with_body(config: TrainConfig, capture: MultiViewCapture) -> TrainConfig:
    """Return the settings with the body file that came from the environment written down."""
    path = capture.body_path
    if config.body is not None or path is None or path.resolve().is_relative_to(capture.root.resolve()):
        return config
    return dataclasses.replace(config, body=str(path.resolve()))


def resumed_settings(run: Run, config: TrainConfig, capture: MultiViewCapture) -> TrainConfig:
    """Return the settings of a run; with the capture that is given now, if it is the same, moved."""
    saved = read_config(run)
    if config.capture != saved.capture and run.scene.exists():
        if not read_scene(run.scene).is_of(scene_of_capture(capture)):
            return saved
        _log.info("Run %s: its capture was %s and is %s now", run.folder, saved.capture, config.capture)
        return dataclasses.replace(saved, capture=config.capture)
    return saved


def with_former_defaults(config: TrainConfig, saved: TrainConfig) -> TrainConfig:
    """Return settings with the defaults of a run's day, where it has them and nothing else was asked."""
    usual = PRESETS[config.preset]
    for setting, former in FORMER_DEFAULTS.items():
        section, name = setting.split(".")
        given, default, kept = (getattr(getattr(c, section), name) for c in (config, usual, saved))
        if given == default and kept == former:
            changed = dataclasses.replace(getattr(config, section), **{name: former})
            config = dataclasses.replace(config, **{section: changed})
    return config


def check_same_settings(config: TrainConfig, saved: TrainConfig, run: Run) -> None:
    """Raise ConfigError where a resumed run would change a setting that its result depends on.

    Its length and its workers may be others, and what it recomputes.
    """
    saved = dataclasses.replace(saved, workers=config.workers)
    free = {name: getattr(config.schedule, name) for name in ("steps", "minutes", "recomputation")}
    saved = dataclasses.replace(saved, schedule=dataclasses.replace(saved.schedule, **free))
    given, recorded = dataclasses.asdict(config), dataclasses.asdict(saved)
    changed = sorted(key for key in given if given[key] != recorded[key])
    if changed:
        raise ConfigError(
            f"--resume: {run.config} was made with other values of {', '.join(changed)}; repeat the command "
            "that started the run, or start another with a new --out"
        )


def divide_anew(config: TrainConfig, saved: TrainConfig) -> TrainConfig:
    """Return the settings with the rollouts that a run began with divided among today's workers.

    Raises:
        ConfigError: they cannot be divided evenly, and every rollout counts alike.
    """
    if config.workers == saved.workers:
        return config
    rollouts = saved.workers * saved.schedule.rollouts_per_worker
    each, rest = divmod(rollouts, config.workers)
    if rest:
        fitting = ", ".join(str(count) for count in range(1, rollouts + 1) if rollouts % count == 0)
        raise ConfigError(
            f"--resume: the run has {rollouts} rollouts ({saved.workers} workers of "
            f"{saved.schedule.rollouts_per_worker}), which {config.workers} workers cannot share evenly; "
            f"resume with one of {fitting}"
        )
    _log.info(
        "The run's %d rollouts are divided among %d workers now, %d each", rollouts, config.workers, each
    )
    schedule = dataclasses.replace(config.schedule, rollouts_per_worker=each)
    return dataclasses.replace(config, schedule=schedule)
