"""What the guards of a rollout cost: their share of a frame that is made, posed and drawn.

    python benchmarks/guards.py [RUN] [--quick] [--json FILE]

Without a run the avatar is that of the preset `demo`, untrained: no guard is faster for what it sees. The
watchdog is timed by itself, beside the frame that it watches, frame by frame: a difference of two rollouts
would drown in the noise of the machine. All are medians over the frames, of the calling thread's own time.
"""

# First, because it imports torch before dsar does; see raster.py.
from machine import describe_machine, read_load  # isort: skip

import argparse
import statistics
import sys
import time
from pathlib import Path

import torch
from results import write_json
from scene import make_camera

from dsar.avatar.avatar import Avatar
from dsar.avatar.player import Player
from dsar.config import PRESETS
from dsar.data.captures.formats import open_capture
from dsar.raster import rasterize
from dsar.training.guard_limits import find_guard_limits, load
from dsar.types import Motion

SIZE = (512, 512)
"""Pixels of the picture that is drawn of each frame."""
LARGEST_SHARE = 0.01


def make_avatar(run: Path | None, motion: Motion) -> Avatar:
    """Return an avatar with guards: a run's, or an untrained one of the embedded capture."""
    if run is not None:
        return load(run)
    capture, config = open_capture(), PRESETS["demo"]
    avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model).eval()
    torch.manual_seed(0)
    torch.nn.init.normal_(avatar.network.decoder.head.weight, std=0.01)
    avatar.guard_limits = find_guard_limits(avatar, [avatar.driving_signal(motion)])
    return avatar


@torch.no_grad()
def measure(avatar: Avatar, motion: Motion) -> dict[str, float]:
    """Return medians over a motion's frames, ms: a frame with its guards, the guards alone, the picture."""
    player, camera = Player(avatar, avatar.driving_signal(motion)), make_camera(*SIZE)
    assert player._watchdog is not None
    watch, spent = player._watchdog.watch, []

    def timed(*arguments):
        start = time.thread_time()
        found = watch(*arguments)
        spent.append(time.thread_time() - start)
        return found

    player._watchdog.watch = timed
    frames, pictures = [], []
    for _ in range(len(motion)):
        start = time.thread_time()
        gaussians = player.step().gaussians
        made = time.thread_time()
        rasterize(gaussians, camera)
        frames.append(made - start)
        pictures.append(time.thread_time() - made)
    times = {"frame": frames, "guards": spent, "picture": pictures}
    return {name: 1e3 * statistics.median(values) for name, values in times.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--quick", action="store_true", help="fewer frames")
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    motion = open_capture().motions["far"].slice(0, 20 if chosen.quick else 160)
    load_before = read_load()
    row = measure(make_avatar(chosen.run, motion), motion)
    share = row["guards"] / (row["frame"] + row["picture"])
    sys.stdout.write(" ".join(f"{name} {value:.3f} ms" for name, value in row.items()) + "\n")
    if chosen.json is not None:
        found = {"machine": describe_machine(), "load": load_before, "ms": row, "share": share}
        write_json(found, chosen.json)
    verdict = "below" if share < LARGEST_SHARE else "NOT below"
    sys.stdout.write(f"guards take {100 * share:.2f} % of a frame, {verdict} {100 * LARGEST_SHARE:g} %\n")


if __name__ == "__main__":
    main()
