"""Which prior of moving cloth carries to unseen motions: all candidates, on true cloth, failures included.

    python benchmarks/prior_candidates.py [--subject CAPTURE] [--quick] [--json FILE [--resume]]
    python benchmarks/prior_candidates.py --draw FILE ... --chart IMAGE

Regression of the simulated truth, not training from images: minutes instead of hours, and a bound on what
images can teach. Errors are root mean squares over frames and points, world mm, of the garment as skinning
carries it. *left out* is over training sequences, each predicted by what was fitted to the rest (`*`: fitted
to all of them). *unseen* is the mean over the motions of `unseen_validation`, and the ratio is to the
template's. Processor times are of one thread, of the fastest of three runs; those of regressions are of plain
NumPy.
"""

import argparse
import json
import os
import shlex
import sys
from dataclasses import asdict
from pathlib import Path

import torch
from machine import describe_machine, read_load
from priors.candidates import Bench, Prediction, list_candidates, mean_square
from priors.chart import draw_chart
from priors.subject import Subject, load_subject
from results import write_json

from dsar.data.captures.formats import open_capture
from dsar.evaluation.results import UnseenMotion
from dsar.evaluation.unseen import summarize_motions

GENERATIONS, QUICK_GENERATIONS = 6, 1
"""Of the search for the simulation's constants."""


def main() -> None:
    """Measure, print, and write what was found; or draw what was written."""
    parser = argparse.ArgumentParser(description="Candidates for a prior of moving cloth.")
    parser.add_argument("--subject", default="embedded", help="a capture with garment truth")
    parser.add_argument("--quick", action="store_true", help="hardly search for constants")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found, row by row")
    parser.add_argument("--resume", action="store_true", help="take the rows that FILE already has")
    parser.add_argument("--draw", type=Path, nargs="+", metavar="FILE", help="measure nothing: draw these")
    parser.add_argument("--chart", type=Path, metavar="IMAGE", help="where the chart goes")
    arguments = parser.parse_args()
    if arguments.draw:
        if not arguments.chart:
            parser.error("--draw needs --chart IMAGE")
        draw_chart([json.loads(path.read_text()) for path in arguments.draw], arguments.chart)
        return
    torch.set_num_threads(1)
    kept = arguments.resume and arguments.json and arguments.json.exists()
    rows = json.loads(arguments.json.read_text())["rows"] if kept else []
    subject = load_subject(open_capture(arguments.subject))
    measure(subject, rows, QUICK_GENERATIONS if arguments.quick else GENERATIONS, arguments.json)


def measure(subject: Subject, rows: list[dict], generations: int, path: Path | None) -> None:
    """Print a row for each candidate, those that are known included, and write them after each."""
    print(_header(subject))
    bench, known = Bench(subject, generations), {row["name"]: row for row in rows}
    found: list[dict] = []
    for name, candidate in list_candidates().items():
        row = known.get(name)
        if row is None:
            prediction = candidate(bench)
            if prediction is None:
                continue
            row = describe(name, subject, prediction)
        found.append(row)
        print(_line(row), flush=True)
        if path:
            facts = {
                "command": shlex.join(sys.argv), "subject": subject.name, "generations": generations,
                **describe_machine(), "threads": os.environ.get("OMP_NUM_THREADS"), "load": read_load(),
            }  # fmt: skip
            write_json(facts | {"rows": found}, path)


def describe(name: str, subject: Subject, prediction: Prediction) -> dict:
    """Return a row."""
    errors = {each: subject.error(each, offsets) for each, offsets in prediction.offsets.items()}
    resting = subject.resting()
    motions = {
        each: UnseenMotion(
            mm=errors[each], mm_template=subject.error(each, resting[each]), mm_second=None,
            frames=len(resting[each]), stops=[],
        )
        for each in subject.validation
    }  # fmt: skip
    figures = asdict(summarize_motions(motions)) if motions else {}
    left_out = [errors[each] for each in subject.train if each in errors]
    return {
        "name": name,
        "left_out": mean_square(left_out) if len(left_out) == len(subject.train) else None,
        "saw_training": prediction.saw_training,
        "mm": figures.get("mm"),
        "ratio": figures.get("ratio"),
        "ratio_ci": figures.get("ratio_ci"),
        **{each: errors.get(each) for each in subject.held_out},
        "motions": {each: errors[each] for each in subject.validation},
        "ms": prediction.ms,
        "details": prediction.details,
    }


def _header(subject: Subject) -> str:
    held_out = "".join(f"{name:>8s}" for name in subject.held_out)
    return f"{subject.name:52s}{'left out':>9s}{'unseen':>8s}{'ratio':>7s}{held_out}{'ms':>8s}"


def _line(row: dict) -> str:
    def number(value: float | None, width: int, digits: int) -> str:
        return f"{'-':>{width}s}" if value is None else f"{value:{width}.{digits}f}"

    star = "*" if row["saw_training"] else " "
    held_out = "".join(number(row[name], 8, 1) for name in ("near", "far") if name in row)
    figures = number(row["left_out"], 8, 1) + star + number(row["mm"], 8, 1) + number(row["ratio"], 7, 3)
    return f"{row['name']:52s}{figures}{held_out}{number(row['ms'], 8, 3)}"


if __name__ == "__main__":
    main()
