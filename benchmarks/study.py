"""Frames a second of every model of a study, anew and in turn: all of them meet the same machine.

    python benchmarks/study.py STUDY [--quick] [--json FILE]

`dsar eval --ablations --baselines` measures a model's speed when it has trained it, hours before or after the
others, and beside whatever the machine does then. Here all models are timed in alternating rounds, and each
gets the medians of its rounds. They take the place of what the study's files say, so that its tables and
chart, made anew by the same `dsar eval` command, hold them. The ratio is to the full model, seed 0.
"""

import argparse
import json
from pathlib import Path
from statistics import median

from machine import describe_machine, read_load
from results import write_json

from dsar.data.captures.formats import capture_of
from dsar.evaluation.profiling import time_rollout
from dsar.evaluation.results import FrameTimes
from dsar.training.checkpoint import Run, load_checkpoint

_ROUNDS = 5
_BASE = "full,seed=0"


def main() -> None:
    """Measure, write into the study's files, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("study", type=Path)
    parser.add_argument("--quick", action="store_true", help="the first four models, once; writes no study")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    folders = sorted(path.parent for path in options.study.glob("*/measured.json"))
    if options.quick:
        base = [folder for folder in folders if folder.name == _BASE]
        folders = [*base, *(folder for folder in folders if folder.name != _BASE)][:4]
    models = {}
    for folder in folders:
        avatar, config, _ = load_checkpoint(Run(folder))
        models[folder.name] = avatar, capture_of(config)
    rounds: dict[str, list[FrameTimes]] = {name: [] for name in models}
    loads = [read_load()]
    for _ in range(1 if options.quick else _ROUNDS):
        for name, (avatar, capture) in models.items():
            rounds[name].append(time_rollout(avatar, capture, capture.splits["test"][0]))
        loads.append(read_load())
    found = {}
    for name, measured in rounds.items():
        ms, slowest = (
            {stage: median(getattr(times, kind)[stage] for times in measured) for stage in measured[0].ms}
            for kind in ("ms", "ms_p95")
        )
        found[name] = {"fps": 1e3 / sum(ms.values()), "ms": ms, "ms_p95": slowest}
    if not options.quick:
        for folder in folders:
            for path in folder.glob("measured*.json"):
                write_json(json.loads(path.read_text()) | found[folder.name], path)
    facts = {"machine": describe_machine(), "loads": loads, "rounds": 1 if options.quick else _ROUNDS}
    if options.json:
        write_json(facts | {"models": found}, options.json)
    for name, each in sorted(found.items(), key=lambda item: -item[1]["fps"]):
        print(f"{each['fps']:7.1f} frames/s  {name}")
    fastest, base = max(each["fps"] for each in found.values()), found[_BASE]["fps"]
    print(f"fastest over the full model: {fastest / base:.2f}")


if __name__ == "__main__":
    main()
