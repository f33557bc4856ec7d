"""A render job that is killed at random, over and over: whether it ends with the bytes of one that is not.

    python benchmarks/killed_farm.py RUN --minutes 60 --json benchmarks/results/killed_farm.json

Each attempt goes on where the last one was killed (`--skip-existing`). Once a shot is whole its files are
compared with those of an undisturbed job, and the next one begins.
"""

import argparse
import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from machine import describe_machine
from results import write_json

SHOT = ("--frames", "1001-1040", "--camera", "cam0,cam3")
LONGEST_S = 40.0
"""Seconds after which an attempt is killed at the latest."""


def main() -> None:
    """Disturb a job for some minutes, and say how it ended."""
    parser = argparse.ArgumentParser(description="Kill a render job at random.")
    parser.add_argument("run", type=Path)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    args = parser.parse_args()
    chance, kills, shots, equal = random.Random(0), 0, 0, True
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole"
        start(args.run, whole).wait()
        expected, began = digests(whole), time.monotonic()
        while time.monotonic() - began < 60 * args.minutes:
            shots += 1
            there = Path(folder) / f"shot-{shots}"
            while not finished(start(args.run, there), chance, began + 60 * args.minutes):
                kills += 1
                found = digests(there)
                equal = equal and found == {name: expected[name] for name in found}
            equal = equal and digests(there) == expected
            print(f"{shots} shots, {kills} kills, {'equal' if equal else 'DIFFERENT'}", flush=True)
    found = {"images": len(expected), "shots": shots, "kills": kills, "equal": equal, "minutes": args.minutes}
    if args.json:
        write_json({"machine": describe_machine(), **found}, args.json)
    if not equal:
        sys.exit(1)


def start(run: Path, out: Path) -> subprocess.Popen:
    """Begin to render what is missing, by two processes in a group of their own."""
    command = [sys.executable, "-m", "dsar", "render", run, "--exr", out, *SHOT]
    command += ["--jobs", "2", "--skip-existing", "--progress", "none"]
    return subprocess.Popen(list(map(str, command)), start_new_session=True, stdout=subprocess.DEVNULL)


def finished(process: subprocess.Popen, chance: random.Random, deadline: float) -> bool:
    """Kill a job with all its processes some time later; return whether it was done before.

    The last one, which begins after the deadline, may go on to its end.
    """
    try:
        process.wait(LONGEST_S * chance.random() if time.monotonic() < deadline else None)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return False
    if process.returncode:
        sys.exit(f"the job ended with {process.returncode} by itself")
    return True


def digests(folder: Path) -> dict[str, str]:
    """Return a digest of every image that is there, by name; not of what a killed job had in hand."""
    images = sorted(folder.glob("*/[!.]*.exr"))
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in images}


if __name__ == "__main__":
    main()
