"""What the motion prior costs a frame, against its slow twin and against the whole frame, in the same run.

    python benchmarks/prior.py [--quick] [--json FILE]

On one core, at the demo's size, for the embedded capture's person in one motion. `prior` is all that a
driving signal costs with it: body and home of every frame, settling before the first, solver, and the way
to the control points. `solver` is the compiled solver alone, `twin` the same steps in plain NumPy
(`dsar.dynamics.reference`). `frame` is one frame of a rollout with everything, the prior included.
"""

# First, because it imports torch before dsar does; see raster.py.
from machine import describe_machine, read_load  # isort: skip

import argparse
import shlex
import sys
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import torch
from results import write_json
from timing import Timing, time_together

from dsar.avatar.avatar import Avatar
from dsar.avatar.driving import DrivingSignal
from dsar.config import PRESETS
from dsar.data.captures.formats import open_capture
from dsar.dynamics.reference import ReferenceCloth, Surroundings
from dsar.dynamics.simulation import STEPS_PER_SECOND, ClothSimulation, ClothState, Fabric, Stage
from dsar.evaluation.profiling import time_rollout
from dsar.types import Capture

SEQUENCE = "far"
TWIN_FRAMES = 2
"""Frames that the slow twin takes in one run."""
CALM_FRAMES = 60
"""Frames after the first at which the solvers begin, so that the body moves."""


def make_avatar(capture: Capture) -> Avatar:
    """Return an untrained avatar of the demo's size, its prior in place."""
    config = PRESETS["demo"]
    torch.manual_seed(0)
    avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model).eval()
    avatar.place_prior()
    return avatar


def solvers(avatar: Avatar, signal: DrivingSignal) -> dict[str, tuple[Callable[[], object], int]]:
    """Return what runs the compiled solver and its twin on the same frames, and on how many."""
    assert avatar.prior is not None
    garment = avatar.prior.garments[0]
    simulation = garment.simulation(avatar.body)
    fabric = simulation.fabric(garment.fabric_constants)
    stage = simulation.stage(signal.steady[: CALM_FRAMES + 2 * TWIN_FRAMES + 1])
    _, state = simulation.advance(
        simulation.begin(stage, fabric, signal.fps), _part(stage, 0, CALM_FRAMES + 1), fabric, signal.fps
    )
    part = _part(stage, CALM_FRAMES, CALM_FRAMES + TWIN_FRAMES + 1)
    return {
        "solver": (partial(simulation.advance, state, part, fabric, signal.fps), TWIN_FRAMES),
        "twin": (partial(_run_twin, simulation, state, part, fabric, signal.fps), TWIN_FRAMES),
    }


def _part(stage: Stage, first: int, last: int) -> Stage:
    arrays = (array[first:last] for array in (stage.home, stage.body, stage.normals))
    return Stage(*arrays, stage.turns[first:last])


def _run_twin(
    simulation: ClothSimulation, state: ClothState, stage: Stage, fabric: Fabric, fps: float
) -> np.ndarray:
    cloth = ReferenceCloth(
        fabric.constants,
        fabric.constraints,
        simulation.collider.neighbours,
        simulation.shape,
        state.points.astype(np.float64),
        state.velocities.astype(np.float64),
        state.nearest.copy(),
    )
    wide = (array.astype(np.float64) for array in (stage.home, stage.body, stage.normals))
    moments = [Surroundings(*moment) for moment in zip(*wide, strict=True)]
    return cloth.simulate(moments, max(1, round(STEPS_PER_SECOND / fps)), fps)


def per_frame(timing: Timing, frames: int) -> dict:
    """Return a timing by frame."""
    values = asdict(timing)
    return {key: value / frames if key.endswith("_ms") else value for key, value in values.items()}


def measure(seconds: float) -> dict:
    """Return what each part takes, milliseconds a frame, and their ratios."""
    capture = open_capture()
    avatar = make_avatar(capture)
    signal = avatar.driving_signal(capture.motions[SEQUENCE])
    runs = {"prior": (partial(avatar.with_cloth, signal), len(signal)), **solvers(avatar, signal)}
    timings = time_together([function for function, _ in runs.values()], seconds, 200)
    rows = {
        name: per_frame(timing, frames)
        for (name, (_, frames)), timing in zip(runs.items(), timings, strict=True)
    }
    stages = time_rollout(avatar, capture, SEQUENCE).ms
    frame = sum(stages.values())
    solver, prior = rows["solver"]["median_ms"], rows["prior"]["median_ms"]
    return {
        "sequence": SEQUENCE,
        "frames": len(signal),
        "rows": rows,
        "frame_ms": {**stages, "total": frame},
        "ratios": {"twin": rows["twin"]["median_ms"] / solver, "share_of_frame": prior / frame},
    }


def main() -> None:
    """Measure, print, and write what was found."""
    parser = argparse.ArgumentParser(description="Time the motion prior against its twin and the frame.")
    parser.add_argument("--quick", action="store_true", help="under a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found = {"command": shlex.join(["python", *sys.argv]), **describe_machine(), "load_before": read_load()}
    found |= measure(4.0 if arguments.quick else 20.0) | {"load_after": read_load()}
    if arguments.json:
        write_json(found, arguments.json)
    for name, row in found["rows"].items():
        spread = f"{row['low_ms']:.3f} - {row['high_ms']:.3f}"
        print(f"{name:7} {row['median_ms']:9.3f} ms a frame ({spread}, {row['runs']} runs)")
    print("frame  " + ", ".join(f"{name} {ms:.2f}" for name, ms in found["frame_ms"].items()) + " ms")
    ratios, prior = found["ratios"], found["rows"]["prior"]["median_ms"]
    print(f"the solver is {ratios['twin']:.0f}x as fast as its slow twin")
    print(f"the prior takes {prior:.2f} ms, {ratios['share_of_frame']:.3f} of the whole frame")


if __name__ == "__main__":
    main()
