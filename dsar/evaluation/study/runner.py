"""Train and measure the models of some tables, one after the other; what is done is never done again."""

import dataclasses
import json
import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

from dsar.atomic_files import write_text_atomically
from dsar.config import PRESETS, TrainConfig, absolute_capture, config_to_json
from dsar.errors import ConfigError
from dsar.evaluation.heldout import evaluate
from dsar.evaluation.stress import CASES, Case, stress
from dsar.evaluation.study.tables import Row, Table
from dsar.network import STREAMS, Stream
from dsar.training.checkpoint import Run, load_checkpoint, read_json, read_progress
from dsar.training.loop import train
from dsar.training.report import Report
from dsar.training.scene import open_images, open_scene

_MEASURING = 120.0
"""Seconds that measuring a model takes on two cores, about."""
_UPDATE = 0.25
"""Seconds of an update, likewise, as long as none was trained here."""
Reporter = Callable[[str, float], None]
"""Is told what is being done, and the share of the study that is done."""


@dataclass(frozen=True)
class Model:
    """One network to train: a row's settings with a seed."""

    settings: Mapping[str, Any]
    seed: int

    @property
    def name(self) -> str:
        """A name for its folder that says how it differs."""
        parts = [f"{key.rpartition('.')[2]}={_short(value)}" for key, value in sorted(self.settings.items())]
        return ",".join([*(parts or ["full"]), f"seed={self.seed}"])


@dataclass(frozen=True)
class Measurement:
    """A model, and the streams that it is measured without."""

    model: Model
    zeroed: tuple[Stream, ...] = ()


@dataclass(frozen=True)
class Study:
    """A folder of models that were trained by equally many updates on one capture."""

    folder: Path
    """Holds a run folder a model, with its figures."""
    steps: int
    """Updates of each model's training."""
    capture: str = "embedded"
    """A capture folder, `embedded` or `embedded-wool`."""
    preset: str = "demo"
    """What the settings of a row start from."""
    cases: Mapping[str, Case] = field(default_factory=lambda: CASES)
    """The stability battery that every model runs."""
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    """Where models are trained and measured."""

    def measurements(self, tables: Sequence[Table]) -> list[Measurement]:
        """Return what the tables need, first seeds first."""
        rows = [row for table in tables for row in table.rows]
        wanted = [
            Measurement(self._model(row, seed), row.zeroed) for row in rows for seed in range(row.seeds)
        ]
        unique = {self._figures(each): each for each in wanted}.values()
        return sorted(unique, key=lambda each: each.model.seed)

    def config(self, model: Model) -> TrainConfig:
        """Return the settings of a model's run.

        Raises:
            ConfigError: a row names a setting that does not exist, or settings contradict each other.
        """
        config = PRESETS[self.preset]
        schedule = dataclasses.replace(config.schedule, steps=self.steps)
        config = dataclasses.replace(
            config, capture=absolute_capture(self.capture), seed=model.seed, schedule=schedule
        )
        for key, value in model.settings.items():
            section, _, name = key.rpartition(".")
            owner = getattr(config, section) if section else config
            if not hasattr(owner, name):
                raise ConfigError(f"a row of the study names {key}, which is no setting")
            changed = dataclasses.replace(owner, **{name: value})
            config = dataclasses.replace(config, **{section: changed}) if section else changed
        config.validate()
        return config

    def run(
        self, tables: Sequence[Table], hours: float | None = None, report: Reporter = lambda *_: None
    ) -> bool:
        """Train and measure what is missing; return whether all of it is there.

        With `hours` nothing is begun that would likely take longer. An interrupted model goes on.
        """
        began, needed, update = time.monotonic(), self.measurements(tables), _UPDATE
        for done, each in enumerate(needed):
            if self._measured(each):
                continue
            if not self._trained(each.model):
                config, run = self.config(each.model), self._run(each.model)
                left = config.schedule.steps * (1 - (read_progress(run).progress if run.exists else 0.0))
                now = time.monotonic()
                if hours is not None and now - began + update * left + _MEASURING > 3600 * hours:
                    return False
                follow = partial(_follow, report, f"train {each.model.name}", done, len(needed))
                train(config, run, resume=run.exists, report=follow, device=self.device)
                update = (time.monotonic() - now) / max(left, 1)
            report(f"measure {each.model.name}", (done + 1) / len(needed))
            self._measure(each)
        report("done", 1.0)
        return True

    def figures(self, row: Row) -> list[dict[str, Any]]:
        """Return what was found of a row, a dictionary a seed; seeds that are missing are left out."""
        each = (Measurement(self._model(row, seed), row.zeroed) for seed in range(row.seeds))
        paths = [self._figures(one) for one in each]
        return [read_json(path) for path in paths if path.exists()]

    def _model(self, row: Row, seed: int) -> Model:
        # A row of the study's own length is the same model as one that names no length.
        same = ("schedule.steps", self.steps)
        return Model({key: value for key, value in row.settings.items() if (key, value) != same}, seed)

    def _run(self, model: Model) -> Run:
        return Run(self.folder / model.name)

    def _figures(self, each: Measurement) -> Path:
        suffix = "".join(f"-without-{stream}" for stream in each.zeroed)
        return self._run(each.model).folder / f"measured{suffix}.json"

    def _measured(self, each: Measurement) -> bool:
        path = self._figures(each)
        if path.exists():
            self._check(path, read_json(path).get("config"), each.model)
        return path.exists()

    def _trained(self, model: Model) -> bool:
        run = self._run(model)
        if run.exists:
            self._check(run.folder, read_json(run.config), model)
        return run.exists and read_progress(run).progress >= 1

    def _check(self, path: Path, settings: Any, model: Model) -> None:
        if isinstance(settings, dict) and isinstance(settings.get("capture"), str):
            settings = {
                **settings,
                "capture": absolute_capture(settings["capture"]),
            }  # older ones were relative
        if settings != json.loads(config_to_json(self.config(model))):
            raise ConfigError(
                f"{path} is of a model with other settings than this study's ({self.steps} updates, "
                f"preset {self.preset}, this version's defaults); give the study another folder"
            )

    def _measure(self, each: Measurement) -> None:
        model, run = each.model, self._run(each.model)
        avatar, config, provenance = load_checkpoint(run, self.device)
        capture = open_images(run, config)
        streams: list[Stream] = [stream for stream in STREAMS if stream not in each.zeroed]
        content = {
            "config": json.loads(config_to_json(config)),
            "settings": dict(model.settings),
            "seed": model.seed,
            **provenance,
        }
        # The battery needs no more than one core and is over when `evaluate` comes to measure times.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as other:
            battery = None if each.zeroed else other.submit(_stress, run.folder, self.cases, self.device)
            content |= {
                "updates": read_progress(run).step,
                **evaluate(avatar, capture, streams=streams).to_json(),
            }
            if battery is not None:
                content["stress"] = battery.result()
        write_text_atomically(self._figures(each), json.dumps(content, indent=1) + "\n")


def _stress(folder: Path, cases: Mapping[str, Case], device: torch.device) -> dict[str, Any]:
    """Return the verdicts on a run, by case."""
    run = Run(folder)
    avatar, config, _ = load_checkpoint(run, device)
    scene = open_scene(run, config)
    far = (scene.splits.get("fd") or scene.splits["test"])[0]
    return {name: verdict.to_json() for name, verdict in stress(avatar, scene.motions[far], cases)}


def _follow(report: Reporter, what: str, done: int, needed: int, line: Report) -> None:
    report(what, (done + min(line.progress, 1.0)) / needed)


def _short(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return "-".join(map(str, value)) or "none" if isinstance(value, tuple) else str(value)
