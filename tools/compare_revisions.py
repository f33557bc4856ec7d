"""Do two revisions compute the same? For changes of names and structure, which must change no number.

    .venv/bin/python tools/compare_revisions.py ../before .

Trains three small avatars for 40 updates at a fixed seed in either working tree (the default with its
registration, the paper's model and its stages, the variants) and rolls each out. Losses must be equal to the
last digit, and the values in splat files byte for byte.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from dsar.config.migrations import RENAMED

FRAMES = "--train-frames 0-9 --test-frames 0-29"
SMALL = "--atlas.resolution 64 --model.channels 8 16 --model.heads 2 --model.upsample 4"
CASES = {
    "demo": "",
    "paper": f"--preset paper {SMALL} --loss.lpips 0 --schedule.half-resolution-fraction 0.5 "
    "--schedule.rollouts-per-worker 2 --schedule.max-rollout-frames 4 --schedule.pose-only-fraction 0.3",
    "variants": "--model.wiring late --model.readout mean --model.no-causal --model.bank features "
    "--model.memory 1 --model.bases 4 --model.pose-components 6 --model.feedback 3 --model.sh-degree 1 "
    "--schedule.pretraining-fraction 0 --schedule.rollouts-per-worker 4 --schedule.chunk-frames 2 "
    "--schedule.mirrored-fraction 0.5 --loss.reduction sum",
}
RUN = """
import sys
import dsar.training.loop as loop, dsar.training.report as report
from dsar.cli import main
loop.REPORT_EVERY = report.REPORT_EVERY = 1
main(sys.argv[1:])
"""


def measure(tree: Path, settings: str, folder: Path) -> dict[str, Any]:
    """Return the losses of 40 updates and hashes of 30 frames of a rollout, as a tree computes them."""
    common = ("--steps", "40", "--workers", "1", "--out", str(folder / "run"), "--progress", "none")
    flags = [renamed(tree, flag) for flag in f"{FRAMES} {settings}".split()]
    run_in(tree, RUN, "train", "embedded", *common, *flags)
    run_in(tree, RUN, "export", str(folder / "run"), "--ply", str(folder / "ply"), "--progress", "none")
    lines = map(json.loads, (folder / "run" / "metrics.jsonl").read_text().splitlines())
    files = sorted((folder / "ply").glob("*.ply"))
    return {
        "losses": [[line["step"], line["loss"], line.get("psnr")] for line in lines],
        "frames": {path.name: hashlib.sha256(splats(path)).hexdigest()[:16] for path in files},
    }


def splats(path: Path) -> bytes:
    """Return the values of a splat file; its header names the checkpoint by a hash of its tensors' names."""
    return path.read_bytes().partition(b"end_header\n")[2]


def run_in(tree: Path, code: str, *arguments: str) -> None:
    """Run code with the packages of a working tree."""
    paths = os.pathsep.join(str(tree / part) for part in ("", "exporters", "render"))
    subprocess.run(
        [sys.executable, "-c", code, *arguments],
        check=True,
        cwd=tree,
        # With more threads sums are added in another order.
        env=os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"},
    )


def renamed(tree: Path, flag: str) -> str:
    """Return a flag by the name that it has in a tree, which may not know of later ones."""
    old = {new: old for old, new in RENAMED.items()}.get(flag[2:].replace("-", "_"))
    known = "".join(path.read_text() for path in (tree / "dsar").glob("config*") if path.is_file())
    known += "".join(path.read_text() for path in (tree / "dsar" / "config").glob("*.py"))
    name = flag.rpartition(".")[2].replace("-", "_")
    return "--" + old.replace("_", "-") if old and f"    {name}: " not in known else flag


def main() -> None:
    """Compare; exit with 1 where anything differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--cases", nargs="*", choices=CASES, default=list(CASES))
    arguments = parser.parse_args()
    different = False
    for name in arguments.cases:
        measured = []
        for tree in (arguments.before, arguments.after):
            with tempfile.TemporaryDirectory() as folder:
                measured.append(measure(tree.resolve(), CASES[name], Path(folder)))
        before, after = measured
        losses = sum(a == b for a, b in zip(before["losses"], after["losses"], strict=True))
        frames = sum(before["frames"].get(key) == value for key, value in after["frames"].items())
        same = before == after
        different |= not same
        count, total = len(before["losses"]), len(before["frames"])
        sys.stdout.write(f"{name:9s} losses {losses}/{count} equal, frames {frames}/{total} equal\n")
    sys.exit(different)


if __name__ == "__main__":
    main()
