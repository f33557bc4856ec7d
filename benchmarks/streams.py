"""What each of the two streams is worth to a trained run, how long its cloth swings, and whether it drifts.

    python benchmarks/streams.py RUN [--quick] [--json FILE]

Held-out sequences, free rollouts from a cold start, PSNR in the mask's box (means over views). A stream is
taken away from a network that was trained with it: an upper bound of what it is worth, because a network that
is trained without it makes up for some of it.
"""

import argparse
import dataclasses
import json
import statistics
from pathlib import Path

import torch
from results import write_json

from dsar.avatar.avatar import Avatar
from dsar.avatar.rollout import START_FRAME, network_outputs, roll_out
from dsar.data.captures.formats import capture_of
from dsar.data.captures.multiview import MultiViewCapture
from dsar.evaluation.looping import loop_motion
from dsar.evaluation.one_to_many import one_to_many
from dsar.evaluation.settling import rms_speeds, settling_time
from dsar.evaluation.view_metrics import compare, evaluate_sequence
from dsar.evaluation.views import render_white, true_view
from dsar.training.checkpoint import Run, load_checkpoint

VARIANTS = {"both": ("geometric", "state"), "state": ("state",), "geometric": ("geometric",), "none": ()}
SLOW = 0.2
"""Share of the true speed at the stop below which cloth has settled."""
HORIZONS = (1, 10, 50)


def measure_streams(avatar: Avatar, capture: MultiViewCapture, stride: int) -> dict:
    """Return PSNR and one-to-many figures with both streams, each alone, and none."""
    found = {}
    for name, streams in VARIANTS.items():
        row = {}
        for sequence in capture.splits["test"]:
            rows = evaluate_sequence(avatar, capture, sequence, stride, streams=streams)
            for key in ("psnr", "psnr_box", "psnr_box_template"):
                row[f"{sequence}.{key}"] = statistics.fmean(getattr(view, key) for view in rows)
        pairs = one_to_many(avatar, capture, streams=streams)
        found[name] = row | {"one_to_many": None if pairs is None else dataclasses.asdict(pairs)}
    return found


def measure_settling(avatar: Avatar, capture: MultiViewCapture) -> dict:
    """Return how long the garment moves after the stop, seconds: the true one and each variant's."""
    pair, garment = capture.one_to_many[0], avatar.garment_control_points()
    motion, (start, end) = capture.motions[pair.sequence], pair.after_stop
    true = rms_speeds(torch.from_numpy(capture.garment(pair.sequence)), motion.fps)
    slow = SLOW * float(true[start])
    found = {"stretch": (end - start) / motion.fps, "slow": slow}
    found["true"] = settling_time(true, start, end, slow, motion.fps)
    for name, streams in VARIANTS.items():
        points = torch.cat(
            [
                avatar.deformed_control_points(motion_window, output)[:, garment]
                for motion_window, output in network_outputs(avatar, motion, streams=streams)
            ]
        )
        speeds = rms_speeds(points.detach(), motion.fps)
        found[name] = settling_time(speeds, start, end, slow, motion.fps)
        found[f"{name}.speeds"] = [round(float(speed), 3) for speed in speeds[start:end:4]]
    found["true.speeds"] = [round(float(speed), 3) for speed in true[start:end:4]]
    return found


def measure_horizon(
    avatar: Avatar, capture: MultiViewCapture, stride: int, horizons: tuple[int, ...]
) -> dict:
    """Return the root mean square error in the mask's box of the rounds that lie at multiples of a clip."""
    sequence = capture.splits["fd"][0] if capture.splits.get("fd") else capture.splits["test"][0]
    motion = capture.motions[sequence]
    clip = statistics.fmean(len(capture.motions[name]) for name in capture.splits["train"])
    _, period = loop_motion(motion, 1)
    rounds = {horizon: int(horizon * clip) // period for horizon in horizons}
    long, _ = loop_motion(motion, max(rounds.values()) + 1)
    chosen = {
        START_FRAME + period * index + frame: frame
        for index in set(rounds.values())
        for frame in range(0, len(motion), stride)
    }
    errors: dict[int, list[float]] = {}
    for number, gaussians in roll_out(avatar, long, frames=sorted(chosen)):
        frame, index = chosen[number], (number - START_FRAME) // period
        for k, camera in enumerate(capture.cameras):
            image = render_white(gaussians, camera)
            psnr = compare(frame, k, image, image, true_view(capture, sequence, frame, k)).psnr_box
            errors.setdefault(index, []).append(10 ** (-psnr / 10))
    rms = {str(h): statistics.fmean(errors[index]) ** 0.5 for h, index in rounds.items()}
    return {"clip": clip, "rounds": rounds, "rms": rms, "frames": len(long)}


@torch.no_grad()
def main() -> None:
    """Measure, print, and write what was found."""
    parser = argparse.ArgumentParser(description="What the streams of a trained run are worth.")
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--quick", action="store_true", help="fewer frames, under a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    avatar, config, provenance = load_checkpoint(Run(arguments.run))
    capture = capture_of(config)
    stride, horizons = (20, (1, 10)) if arguments.quick else (4, HORIZONS)
    found = {"run": str(arguments.run), **provenance, "wiring": config.model.wiring, "seed": config.seed}
    found |= {
        "memory_weight": float(avatar.network.bank.memory_logit.sigmoid()) if avatar.network.bank else None
    }
    found["streams"] = measure_streams(avatar, capture, stride)
    found["settling"] = measure_settling(avatar, capture)
    found["horizon"] = measure_horizon(avatar, capture, 2 * stride, horizons)
    print(json.dumps(found, indent=1))
    if arguments.json:
        write_json(found, arguments.json)
    both, settling, rms = found["streams"]["both"], found["settling"], found["horizon"]["rms"]
    boxes = [key for key in both if key.endswith("psnr_box")]
    for name in ("state", "geometric", "none"):
        costs = (f"{key} {found['streams'][name][key] - both[key]:+.2f} dB" for key in boxes)
        print(f"{name} alone:", ", ".join(costs))
    print(f"settles in {settling['both']:.2f} s, the true garment in {settling['true']:.2f} s")
    first = rms[str(horizons[0])]
    print("error by horizon:", ", ".join(f"{horizon}x {error / first:.3f}" for horizon, error in rms.items()))


if __name__ == "__main__":
    main()
