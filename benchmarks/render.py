"""How many images a second `dsar render` writes, where the time goes, and what more processes bring.

    python benchmarks/render.py runs/demo --json benchmarks/results/render.json

The rival is the plain loop: for each frame, for each camera, rasterise and write, one after the other in one
process. `--jobs 1` draws and writes in a thread beside the rollout, `--jobs 2` in two processes. Rounds
alternate, so that all meet the same machine. Start-up (imports, the pool's processes) is left out by counting
over the last two thirds of the frames. The estimate for many machines is on paper: the rollout is serial, the
rest divides.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from statistics import median

import torch
from machine import describe_machine, read_load
from results import write_json

from dsar.avatar import roll_out
from dsar.data.captures.formats import capture_of
from dsar.geometry.camera_paths import CameraPath
from dsar.raster import rasterize
from dsar.training.checkpoint import Run, load_checkpoint
from dsar.types import Camera, GaussianSequence
from dsar_exporters import ExrSequence
from dsar_render import RenderSettings, Shot, iterate_triplets, label_sequence, render_picture, render_shot
from dsar_render.aovs import Aov

_ROUNDS = 3
_MACHINES = 100
_FULL: tuple[Aov, ...] = ("rgba", "Z", "N", "P", "motion", "id", "crypto")
_PLAIN: tuple[Aov, ...] = ("rgba", "Z")
_LAYERS: dict[str, tuple[Aov, ...]] = {",".join(_PLAIN): _PLAIN, ",".join(_FULL): _FULL}
_FRAMES = {",".join(_PLAIN): 75, ",".join(_FULL): 30}


def time_stages(sequence: GaussianSequence, path: CameraPath, layers: tuple[Aov, ...], folder: Path) -> dict:
    """Return the milliseconds of each stage, medians over frames: the rollout a frame, the rest an image."""
    writer, settings, labels = (
        ExrSequence(folder, layers=layers),
        RenderSettings(aovs=layers),
        label_sequence(sequence),
    )
    stages: dict[str, list[float]] = {name: [] for name in ("rollout", "raster", "aovs", "color", "encode")}
    triplets = iterate_triplets(sequence, list(sequence.frame_numbers))
    while True:
        marks = [time.perf_counter()]
        triplet = next(triplets, None)
        if triplet is None:
            break
        marks.append(time.perf_counter())
        rasterize(triplet.current, path.at(triplet.frame))
        marks.append(time.perf_counter())
        picture = render_picture(triplet, path, settings, labels=labels, fps=sequence.fps)
        marks.append(time.perf_counter())
        writer.target.premultiplied(picture.output.color.numpy(), picture.output.alpha.numpy())
        marks.append(time.perf_counter())
        writer.write([picture], [""])
        marks.append(time.perf_counter())
        for stage, start, end in zip(stages, marks, marks[1:], strict=False):
            stages[stage].append(1e3 * (end - start))
    found = {stage: median(times[2:]) for stage, times in stages.items()}
    # A picture draws the image again, and writing converts its colours again.
    found["aovs"] = max(found["aovs"] - found["raster"], 0.0)
    found["encode"] = max(found["encode"] - found["color"], 0.0)
    return found


def run_plain(
    sequence: GaussianSequence, cameras: list[Camera], layers: tuple[Aov, ...], folder: Path
) -> float:
    """Return images a second of the plain loop, over the last two thirds of the frames."""
    shot = Shot(
        tuple(CameraPath((camera,)) for camera in cameras),
        (ExrSequence(folder, layers=layers),),
        RenderSettings(aovs=layers),
    )
    labels = label_sequence(sequence)
    ends = []
    frames, neighbours = list(sequence.frame_numbers), shot.settings.needs_neighbours
    for triplet in iterate_triplets(sequence, frames, neighbours=neighbours):
        for path in shot.paths:
            picture = render_picture(triplet, path, shot.settings, labels=labels, fps=sequence.fps)
            shot.writers[0].write([picture], [""])
        ends.append(time.perf_counter())
    return _rate(ends, len(cameras))


def run_jobs(
    sequence: GaussianSequence, cameras: list[Camera], layers: tuple[Aov, ...], folder: Path, jobs: int
) -> float:
    """Return images a second of `render_shot`, over the last two thirds of the frames."""
    shot = Shot(
        tuple(CameraPath((camera,)) for camera in cameras),
        (ExrSequence(folder, layers=layers),),
        RenderSettings(aovs=layers),
    )
    ends = [time.perf_counter() for _ in render_shot(shot, sequence, list(sequence.frame_numbers), jobs=jobs)]
    return _rate(ends, len(cameras))


def _rate(ends: list[float], cameras: int) -> float:
    """Return images a second over the last two thirds of the frames: until then the second process starts."""
    first = len(ends) // 3
    return cameras * (len(ends) - 1 - first) / (ends[-1] - ends[first])


def estimate(stages: dict, cameras: int) -> dict:
    """Return what many machines would do, from the serial rollout and what divides."""
    serial, parallel = (
        stages["rollout"],
        cameras * sum(stages[s] for s in ("raster", "aovs", "color", "encode")),
    )
    alone, many = serial + parallel, max(serial, parallel / _MACHINES)
    return {
        "machines": _MACHINES,
        "ms_per_frame_serial": serial,
        "ms_per_frame_parallel": parallel,
        "serial_fraction": serial / alone,
        "speed_up": alone / many,
        "machines_that_pay": parallel / serial,
    }


def main() -> None:
    """Measure, print, and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--quick", action="store_true", help="fewer frames, under a minute")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    # Small tensors gain nothing from a second thread.
    torch.set_num_threads(1)
    avatar, config, provenance = load_checkpoint(Run(options.run))
    capture = capture_of(config)
    motion = capture.motions[next(iter(capture.splits["test"]))]
    cameras = list(capture.cameras)
    first = cameras[0]
    found: dict = {"machine": describe_machine(), "load_before": read_load(), "run": options.run.name}
    found |= {"gaussians": avatar.num_gaussians, "cameras": len(cameras)}
    found |= {"size": [first.width, first.height], "layers": {}}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for label, layers in _LAYERS.items():
            count = _FRAMES[label] // (3 if options.quick else 1)
            frames = list(range(1001, 1001 + count))
            sequence = roll_out(avatar, motion, frames=frames, provenance=provenance)
            stages = time_stages(sequence, CameraPath((first,)), layers, folder)
            rounds = []
            for _ in range(1 if options.quick else _ROUNDS):
                plain = run_plain(sequence, cameras, layers, folder)
                one, two = (run_jobs(sequence, cameras, layers, folder, jobs) for jobs in (1, 2))
                rounds.append({"plain": plain, "jobs 1": one, "jobs 2": two})
            rates = {key: median(each[key] for each in rounds) for key in rounds[0]}
            found["layers"][label] = {
                "frames": count,
                "ms": stages,
                "images_per_s": rates,
                "rounds": rounds,
                "two_over_one": median(each["jobs 2"] / each["jobs 1"] for each in rounds),
                "two_over_plain": median(each["jobs 2"] / each["plain"] for each in rounds),
                "estimate": estimate(stages, len(cameras)),
            }
    found["load_after"] = read_load()
    print(json.dumps({key: value for key, value in found.items() if key != "machine"}, indent=1))
    if options.json:
        write_json(found, options.json)
    for label, each in found["layers"].items():
        print(f"{label}: two processes over one: {each['two_over_one']:.2f}")
        print(f"{label}: two processes over the plain loop: {each['two_over_plain']:.2f}")


if __name__ == "__main__":
    main()
