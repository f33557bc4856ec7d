"""Do two revisions compute the same? For changes of names and structure, which must change no number.

    .venv/bin/python tools/compare_revisions.py ../before .

Trains three small avatars for 40 updates at a fixed seed in either working tree (the default with its
registration, the paper's model and its stages, the variants) and rolls each out. Losses must be equal to the
last digit, and splat files byte for byte. Settings are given by the names of the tree that is measured.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

FRAMES = ("--train-frames", "0-9", "--test-frames", "0-29")
SMALL = (
    "--atlas.resolution",
    "64",
    "--model.channels",
    "8",
    "16",
    "--model.heads",
    "2",
    "--model.upsample",
    "4",
)
CASES = {
    "demo": (),
    "paper": (
        *("--preset", "paper", *SMALL, "--loss.lpips", "0", "--schedule.half-resolution-fraction", "0.5"),
        *(
            "--schedule.rollouts-per-worker",
            "2",
            "--schedule.max-rollout-frames",
            "4",
            "--schedule.pose-only-fraction",
            "0.3",
        ),
    ),
    "variants": (
        *(
            "--model.wiring",
            "late",
            "--model.readout",
            "mean",
            "--model.no-causal",
            "--model.bank",
            "features",
        ),
        *(
            "--model.memory",
            "1",
            "--model.bases",
            "4",
            "--model.pose-components",
            "6",
            "--model.feedback",
            "3",
        ),
        *(
            "--schedule.pretraining-fraction",
            "0",
            "--schedule.rollouts-per-worker",
            "4",
            "--schedule.chunk-frames",
            "2",
        ),
        *("--schedule.mirrored-fraction", "0.5", "--loss.reduction", "sum", "--model.sh-degree", "1"),
    ),
}
BEFORE = {
    "--schedule.rollouts-per-worker": "--schedule.streams",
    "--schedule.max-rollout-frames": "--schedule.horizon",
    "--schedule.chunk-frames": "--schedule.segment",
    "--schedule.rendered-fraction": "--schedule.rendered",
    "--schedule.mirrored-fraction": "--schedule.mirrored",
    "--schedule.template-fraction": "--schedule.template-share",
    "--schedule.pretraining-fraction": "--schedule.imitation-share",
    "--schedule.pose-only-fraction": "--schedule.pose-share",
    "--schedule.half-resolution-fraction": "--schedule.half-resolution-share",
    "--schedule.muon-rate": "--schedule.matrix-rate",
    "--schedule.finetuning-factor": "--schedule.refinement",
    "--schedule.max-gradient-norm": "--schedule.clip",
}
"""Flags that had another name in revisions without a table of renamed settings."""
RUN = """
import sys
import dsar.training.loop as loop, dsar.training.report as report
from dsar.cli import main
loop.REPORT_EVERY = report.REPORT_EVERY = 1
main(sys.argv[1:])
"""


def measure(tree: Path, settings: tuple[str, ...], folder: Path) -> dict[str, object]:
    """Return the losses of 40 updates and hashes of 30 frames of a rollout, as a tree computes them."""
    common = ("--steps", "40", "--workers", "1", "--out", str(folder / "run"), "--progress", "none")
    run_in(tree, RUN, "train", "embedded", *FRAMES, *common, *map(lambda flag: renamed(tree, flag), settings))
    run_in(tree, RUN, "export", str(folder / "run"), "--ply", str(folder / "ply"), "--progress", "none")
    lines = map(json.loads, (folder / "run" / "metrics.jsonl").read_text().splitlines())
    files = sorted((folder / "ply").glob("*.ply"))
    return {
        "losses": [[line["step"], line["loss"], line.get("psnr")] for line in lines],
        "frames": {path.name: hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in files},
    }


def run_in(tree: Path, code: str, *arguments: str) -> None:
    """Run code with the packages of a working tree."""
    paths = os.pathsep.join(str(tree / part) for part in ("", "exporters", "render"))
    subprocess.run(
        [sys.executable, "-c", code, *arguments], check=True, cwd=tree, env=os.environ | {"PYTHONPATH": paths}
    )


def renamed(tree: Path, flag: str) -> str:
    """Return a flag by the name that it has in a tree."""
    sources = (tree / "dsar").glob("config*")
    texts = [path.read_text() for path in sources if path.is_file()]
    return BEFORE.get(flag, flag) if any("imitation_share: float" in text for text in texts) else flag


def main() -> None:
    """Compare; exit with 1 where anything differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--cases", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--cache", type=Path, help="where what `before` computes is kept")
    arguments = parser.parse_args()
    different = False
    for name in arguments.cases:
        found = []
        for tree in (arguments.before, arguments.after):
            kept = arguments.cache / f"{name}.json" if arguments.cache and tree == arguments.before else None
            if kept is not None and kept.exists():
                found.append(json.loads(kept.read_text()))
                continue
            with tempfile.TemporaryDirectory() as folder:
                found.append(json.loads(json.dumps(measure(tree.resolve(), CASES[name], Path(folder)))))
            if kept is not None:
                kept.parent.mkdir(parents=True, exist_ok=True)
                kept.write_text(json.dumps(found[-1]))
        before, after = found
        losses = sum(a == b for a, b in zip(before["losses"], after["losses"], strict=True))
        frames = sum(before["frames"].get(key) == value for key, value in after["frames"].items())
        same = before == after
        different |= not same
        count, total = len(before["losses"]), len(before["frames"])
        sys.stdout.write(f"{name:9s} losses {losses}/{count} equal, frames {frames}/{total} equal\n")
    sys.exit(different)


if __name__ == "__main__":
    main()
