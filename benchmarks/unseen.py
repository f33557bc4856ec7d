"""How well a run's garment moves on motions that nobody trained on.

    python benchmarks/unseen.py RUN [--split validation|test] [--motions NAME ...] [--json FILE] [--quick]

Root mean square distance of the garment's points from the true ones, mm, in free rollouts from a cold start;
beside it the template under skinning alone, and another true run of the same motion. After each stop: seconds
until the garment is at rest, and how far it swings past its rest, mm, each with the true one in brackets.
`--split test` is for reports alone: choose on `validation`.
"""

import argparse
import dataclasses
from pathlib import Path

import torch
from results import write_json

from dsar.data.captures.formats import capture_of
from dsar.errors import CaptureError
from dsar.evaluation.results import UnseenFigures
from dsar.evaluation.unseen import SPLITS, describe_unseen, measure_motions, summarize_motions
from dsar.training.checkpoint import Run, load_checkpoint

_QUICK = 2


def main() -> None:
    """Measure, print, and write what was found."""
    parser = argparse.ArgumentParser(description="The garment's error on unseen motions.")
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--split", choices=SPLITS, default="validation", help="which motions")
    parser.add_argument("--motions", nargs="+", metavar="NAME", help="these sequences instead of a split's")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    parser.add_argument("--quick", action="store_true", help="the first two motions alone")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    avatar, config, provenance = load_checkpoint(Run(arguments.run))
    capture = capture_of(config)
    names = arguments.motions or capture.splits.get(SPLITS[arguments.split], ())
    if not names:
        raise CaptureError(f"capture {capture.name} has no unseen motions of {arguments.split}")
    names = names[:_QUICK] if arguments.quick else names
    figures = summarize_motions(measure_motions(avatar, capture, names))
    label = "motions" if arguments.motions else arguments.split
    if arguments.json:
        facts = {"run": str(arguments.run), **provenance, "seed": config.seed, "split": label}
        write_json(facts | dataclasses.asdict(figures), arguments.json)
    print_table(figures)
    print(describe_unseen(label, figures))


def print_table(figures: UnseenFigures) -> None:
    """Print a line for each motion, and one for each of its stops."""
    print(f"{'':20s} {'mm':>7s} {'template':>9s} {'second':>7s} {'ratio':>6s} {'frames':>7s}")
    for name, motion in figures.motions.items():
        second = "-" if motion.mm_second is None else f"{motion.mm_second:.1f}"
        ratio = motion.mm / motion.mm_template
        errors = f"{motion.mm:7.1f} {motion.mm_template:9.1f} {second:>7s} {ratio:6.3f}"
        print(f"{name:20s} {errors} {motion.frames:7d}")
        for stop in motion.stops:
            settle = f"settles in {stop.settle:.2f} s ({stop.settle_true:.2f}) of {stop.seconds:.2f}"
            swing = f"swings on by {stop.overshoot:.0f} mm ({stop.overshoot_true:.0f})"
            print(f"    stop at {stop.frame}: {settle}, {swing}")


if __name__ == "__main__":
    main()
