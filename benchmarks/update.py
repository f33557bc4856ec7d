"""What an update of the demo costs, by stage: processor time of one worker on one thread.

    .venv/bin/python benchmarks/update.py --before ../before --json benchmarks/results/update.json

With `--before` it is compared with another working tree, in processes that take turns; else with itself where
nothing is kept from one update to the next (images are decoded and input maps made each time). Losses of both
are compared, too: a faster update is the same update.
"""

import argparse
import json
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import describe_machine, read_load
from results import write_json
from torch import nn

from dsar.avatar.avatar import Avatar
from dsar.config import PRESETS
from dsar.data.captures.formats import open_capture
from dsar.training.chunk import ChunkTrainer
from dsar.training.loop import rest_frames, training_clips
from dsar.training.optimizers import set_rates
from dsar.training.registration import Registration
from dsar.training.schedule import schedule_at
from dsar.training.state import TrainingState
from dsar.training.workers import Gradients

PROGRESS = {"template": 0.06, "pretraining": 0.2, "reduced": 0.6, "whole": 0.9}
"""Places in the schedule, by what they measure; images are reduced or whole."""
FIRST_FRAME = 30
"""Registered frames are measured from here on."""


def images(capture: Any, *, kept: bool) -> Any:
    """Return the images that training reads, all of them kept; revisions before kept none."""
    try:
        from dsar.training.kept_views import KeptViews
    except ImportError:
        return capture
    views = KeptViews(capture) if kept else KeptViews(capture, 0)
    for name in capture.splits["train"] if kept else ():
        for frame in range(len(capture.motions[name])):
            for camera in capture.cameras_with_image(name, frame):
                views.read(name, frame, camera)
    return views


class Worker:
    """One worker of the demo, its template fitted a little."""

    def __init__(self, template_updates: int, *, kept: bool) -> None:
        torch.manual_seed(0)
        self.config, capture = PRESETS["demo"], open_capture()
        atlas, model = self.config.atlas, self.config.model
        avatar = Avatar.from_capture(capture, capture.body, atlas, model).train()
        clips = training_clips(capture)
        signals = {name: avatar.driving_signal(capture.motions[name]) for name in clips}
        still = rest_frames(capture, signals, clips, avatar.fps)
        self.state = state = TrainingState.begin(self.config, capture, avatar, clips, still)
        views = images(capture, kept=kept)
        self.trainer = ChunkTrainer(self.config, views, state, signals, None)
        if not kept:
            from dsar.training.driving_maps import DrivingMaps

            self.trainer.driving = DrivingMaps(avatar, signals, mirrored=True, capacity=0)
        self.registration = Registration(self.config, views, avatar, state.rest, state.registered, signals)
        self.gradients = Gradients([*avatar.parameters(), *state.rest.parameters()])
        for update in range(template_updates):
            self.update("template", 0.12 * update / template_updates)
        avatar.unhide_covered_texels()
        for name, clip in clips.items():
            state.registered.fitted[name] = torch.tensor(len(clip))

    def update(self, part: str, progress: float) -> float:
        """Do one update; return its loss."""
        state, now = self.state, schedule_at(self.config.schedule, progress)
        set_rates(state.optimizers, now)
        rng = np.random.default_rng([0, 0, state.step])
        self.gradients.clear()
        if part == "template":
            metrics = self.trainer.backward_template(rng, now.reduction)
        elif part == "pretraining":
            metrics = self.trainer.backward_pretraining(rng)
        else:
            metrics = self.trainer.backward_chunk(rng, now)
        nn.utils.clip_grad_norm_(state.avatar.network.parameters(), self.config.schedule.max_gradient_norm)
        for optimizer in state.optimizers.values():
            optimizer.step()
        state.step += 1
        return metrics.loss

    def register(self) -> float:
        """Register the next frame; return its loss."""
        metrics = self.registration.fit_next()
        assert metrics is not None, "cameras saw every frame"
        return metrics.loss

    def measure(self, updates: int) -> dict[str, Any]:
        """Return milliseconds of processor time by part, and losses."""
        found: dict[str, Any] = {"ms": {}, "losses": {}}

        def timed(part: str, work: Any) -> None:
            times, losses = [], []
            for update in range(-2, updates):
                began = time.process_time()
                losses.append(work())
                if update >= 0:
                    times.append(1e3 * (time.process_time() - began))
            found["ms"][part], found["losses"][part] = times, losses

        for part, progress in PROGRESS.items():
            timed(part, lambda part=part, progress=progress: self.update(part, progress))
        self.registration.maps.count = FIRST_FRAME
        timed("registration", self.register)
        return found


def measure_tree(tree: Path, updates: int, template_updates: int) -> dict[str, Any]:
    """Measure in a process of its own, with the packages of a working tree."""
    with tempfile.TemporaryDirectory() as folder:
        found = Path(folder) / "found.json"
        paths = os.pathsep.join(str(tree / part) for part in ("", "exporters", "render"))
        counts = (str(updates), str(template_updates))
        subprocess.run(
            [sys.executable, str(Path(__file__).resolve()), "--child", *counts, "--json", str(found)],
            check=True,
            cwd=tree,
            env=os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"},
        )
        return json.loads(found.read_text())


def summarize(before: list[dict], after: list[dict]) -> dict[str, Any]:
    """Return medians of both by part, their ratio, and how far losses are apart."""
    rows = {}
    for part in after[0]["ms"]:
        medians = [
            statistics.median(t for each in runs for t in each["ms"][part]) for runs in (before, after)
        ]
        losses = np.array([runs[0]["losses"][part] for runs in (before, after)])
        rows[part] = {
            "before_ms": medians[0],
            "after_ms": medians[1],
            "ratio": medians[0] / medians[1],
            # The first of pretraining is 0: nothing is registered here, and nothing learnt.
            "losses_apart": float(np.abs(losses[0] - losses[1]).max() / np.abs(losses[0]).max()),
        }
    return rows


def whole_run(rows: dict[str, Any], key: str) -> float:
    """Return the seconds of a whole run of the demo in one of two workers."""
    config = PRESETS["demo"]
    schedule = config.schedule
    images_from = schedule.template_fraction + schedule.pretraining_fraction
    counts = {
        "template": schedule.steps * schedule.template_fraction,
        "pretraining": schedule.steps * schedule.pretraining_fraction,
        "reduced": schedule.steps * (schedule.half_resolution_fraction - images_from),
        "whole": schedule.steps * (1 - schedule.half_resolution_fraction),
    }
    capture = open_capture()
    frames = sum(len(capture.motions[name]) for name in capture.splits["train"])
    counts["registration"] = frames / config.workers
    return sum(count * rows[part][key] for part, count in counts.items()) / 1e3


def main() -> None:
    """Measure, print, and write what was found."""
    parser = argparse.ArgumentParser(description="What an update of the demo costs, by stage.")
    parser.add_argument("--before", type=Path, metavar="TREE", help="another working tree to compare with")
    parser.add_argument("--quick", action="store_true", help="fewer updates, under a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    parser.add_argument("--child", type=int, nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.child:
        updates, template_updates = arguments.child
        write_json(Worker(template_updates, kept=True).measure(updates), arguments.json)
        return
    rounds, updates, template_updates = (1, 4, 10) if arguments.quick else (3, 12, 60)
    before, after = [], []
    for _ in range(rounds):
        if arguments.before:
            before.append(measure_tree(arguments.before.resolve(), updates, template_updates))
            after.append(measure_tree(Path(__file__).resolve().parents[1], updates, template_updates))
        else:
            before.append(Worker(template_updates, kept=False).measure(updates))
            after.append(Worker(template_updates, kept=True).measure(updates))
    rows = summarize(before, after)
    seconds = [whole_run(rows, key) for key in ("before_ms", "after_ms")]
    found = {"parts": rows, "run_seconds": seconds, "rounds": rounds, "updates": updates}
    found |= {"command": shlex.join(["python", *sys.argv]), **describe_machine(), "load": read_load()}
    if arguments.json:
        write_json(found, arguments.json)
    for part, row in rows.items():
        times = f"{row['before_ms']:6.1f} -> {row['after_ms']:6.1f} ms"
        print(f"{part:13s} {times}  losses {row['losses_apart']:.1e} apart  {row['ratio']:.2f} times as fast")
    ratio = seconds[0] / seconds[1]
    print(f"a run of the demo: {seconds[0]:.0f} -> {seconds[1]:.0f} s, {ratio:.2f} times as fast")


if __name__ == "__main__":
    main()
