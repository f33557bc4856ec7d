"""What the demo's true skirt does after the spin of the stability case `stop`, beside an avatar's.

    python benchmarks/true_stop.py RUN --json benchmarks/results/true_stop.json

The embedded capture's own solver simulates the spin twice, the second time slightly disturbed. Distances are
rms over the skirt's points from where they end up, at the stop and three seconds later.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from machine import describe_machine
from results import write_json

from dsar.body.files import load_body
from dsar.evaluation.stress.motions import spin_and_stop
from dsar.evaluation.stress.rollouts import roll_offsets
from dsar.training.checkpoint import Run, load_checkpoint
from dsar.training.scene import open_scene

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
from capture.garment import fit_skirt
from capture.subjects import SUBJECTS, draper

SECONDS = 3.0


def main() -> None:
    """Simulate, roll out, and compare."""
    parser = argparse.ArgumentParser(description="The true skirt after a spin that stops at once.")
    parser.add_argument("run", type=Path, help="a run of the embedded capture")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    args = parser.parse_args()
    torch.set_num_threads(1)
    avatar, config, _ = load_checkpoint(Run(args.run))
    spin, stop = spin_and_stop(open_scene(Run(args.run), config).motions["far"])
    body, subject = load_body(), SUBJECTS["embedded"]
    skirt, drape = fit_skirt(body, subject.cut), draper(subject, None)
    paths = {
        f"true, run {run}": torch.from_numpy(np.asarray(drape(body, skirt, spin, run))) for run in (0, 1)
    }
    with torch.no_grad():
        paths["avatar"] = roll_offsets(avatar, spin)[:, avatar.garment_control_points()]
    found = {}
    for name, points in paths.items():
        distances = 1000 * (points[stop:] - points[-1]).square().sum(-1).mean(-1).sqrt()
        at_stop, later = float(distances[0]), float(distances[round(SECONDS * spin.fps) :].amax())
        found[name] = {"mm_at_stop": at_stop, "mm_later": later, "share": later / at_stop}
        share = later / at_stop
        print(f"{name:12s} {at_stop:.1f} mm at the stop, {later:.1f} from {SECONDS:g} s on: {share:.3f}")
    if args.json:
        write_json({"machine": describe_machine(), "seconds": SECONDS, "stops": found}, args.json)


if __name__ == "__main__":
    main()
