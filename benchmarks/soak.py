"""100,000 frames in one rollout: memory, drift, and whether all stays finite.

    python benchmarks/soak.py RUN --json benchmarks/results/soak.json

The first half repeats the held-out motion that is furthest from training; the second strings the capture's
motions together by chance, with a second from each to the next. Every hundredth frame is posed as well.
"""

import argparse
import dataclasses
import resource
import time
from itertools import pairwise
from pathlib import Path

import torch
from machine import describe_machine
from results import write_json

from dsar.avatar.rollout import network_outputs
from dsar.data.motions.files import resample
from dsar.evaluation.looping import loop_motion
from dsar.training.checkpoint import Run, load_checkpoint
from dsar.training.scene import Scene, open_scene
from dsar.types import Motion

BLOCK = 1000
"""Frames whose mean offset is one point of the curve."""
POSED_EVERY = 100


def main() -> None:
    """Roll out, and say what became of it."""
    parser = argparse.ArgumentParser(description="A rollout of very many frames.")
    parser.add_argument("run", type=Path)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    args = parser.parse_args()
    torch.set_num_threads(1)
    avatar, config, _ = load_checkpoint(Run(args.run))
    scene = open_scene(Run(args.run), config)
    far = scene.motions[next(iter(scene.splits.get("fd", scene.splits["test"])))]
    _, period = loop_motion(far, 1)
    looped, _ = loop_motion(far, -(-args.frames // 2 // period))
    motion = _joined([looped, *_random_clips(scene, far.fps, args.frames - len(looped))], far.fps)
    found = soak(avatar, motion, len(looped), period)
    print(
        f"{found['frames']} frames in {found['seconds']:.0f} s; drift {100 * found['drift']:.3f} % per 1000 "
        f"frames; largest offset {found['largest_m']:.3f} m; memory +{found['memory_growth_mib']:.0f} MiB"
    )
    if args.json:
        write_json({"machine": describe_machine(), **found}, args.json)


@torch.no_grad()
def soak(avatar, motion: Motion, looped: int, period: int) -> dict:
    """Return what a rollout did: drift of the looped part, largest offset, and growth of the memory."""
    began, sizes, largest, memory = time.perf_counter(), [], 0.0, 0.0
    windows = avatar.driving_signal(motion).windows
    for frame, (_, output) in enumerate(network_outputs(avatar, motion)):
        offset = avatar.gather_control_points(output.offset)[0].norm(dim=-1)
        sizes.append(float(offset.mean()))
        largest = max(largest, float(offset.amax()))
        if frame % POSED_EVERY == 0:
            gaussians = avatar.gaussians(windows[frame : frame + 1], output)[0]
            if not all(getattr(gaussians, f.name).isfinite().all() for f in dataclasses.fields(gaussians)):
                raise SystemExit(f"frame {frame}: a Gaussian is not finite")
        if frame == BLOCK:
            memory = _peak_mib()
    rounds = torch.tensor(sizes[: looped // period * period], dtype=torch.float64).reshape(-1, period).mean(1)
    centred = torch.arange(len(rounds), dtype=torch.float64) - (len(rounds) - 1) / 2
    slope = float((centred * rounds).sum() / centred.square().sum()) * 1000 / period / float(rounds.mean())
    blocks = torch.tensor(sizes).split(BLOCK)
    return {
        "frames": len(sizes),
        "seconds": time.perf_counter() - began,
        "finite": bool(torch.tensor(sizes).isfinite().all()),
        "drift": abs(slope),
        "largest_m": largest,
        "memory_growth_mib": _peak_mib() - memory,
        "mean_mm": [round(1000 * float(block.mean()), 3) for block in blocks],
    }


def _random_clips(scene: Scene, fps: float, frames: int) -> list[Motion]:
    generator, names, clips = torch.Generator().manual_seed(0), list(scene.motions), list[Motion]()
    while sum(map(len, clips)) < frames:
        name = names[int(torch.randint(len(names), (), generator=generator))]
        clips.append(resample(scene.motions[name], fps))
    return clips


def _joined(clips: list[Motion], fps: float) -> Motion:
    """Return motions one after another, with a second from each one's end to the next one's start."""
    parts = [clips[0]]
    for before, after in pairwise(clips):
        ends = dataclasses.replace(
            before,
            rotations=torch.stack([before.rotations[-1], after.rotations[0]]),
            translations=torch.stack([before.translations[-1], after.translations[0]]),
            fps=1.0,
        )
        parts += [resample(ends, fps), after]
    rotations, translations = (
        torch.cat([getattr(p, n) for p in parts]) for n in ("rotations", "translations")
    )
    return dataclasses.replace(clips[0], name="soak", rotations=rotations, translations=translations)


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
