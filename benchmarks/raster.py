"""How fast the CPU rasteriser is, against others and against the processor, in the same run.

    python benchmarks/raster.py [--quick] [--json FILE] [--chart DIR]

A body-like shell of Gaussians, forward and forward + backward by every field (from a gradient of the colour
image), projection and colour included. Medians and quartiles, with one thread and with two.
The rivals are those of benchmarks/rivals; `pip install -c constraints.txt -e '.[bench]'` brings their
packages. Torch with two threads is timed as it comes, with idle threads that spin: while other processes want
the cores, single runs of it take ten times as long.
"""

# First, because it imports torch before dsar does: dsar lets torch's idle threads sleep, and so plain torch
# would take two to three times as long with two threads as its other users see.
from machine import count_memory, describe_machine, measure_peak, read_load  # isort: skip

import argparse
import gc
import importlib.util
import shlex
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numba
import numpy as np
import torch
from fragments import Work, count_work
from raster_kernels import measure_kernels
from report import describe_arithmetic, describe_ratio, describe_rival, describe_row, describe_stages
from results import write_json
from rivals import NOT_COMPARED, OURS, RIVALS, Rival, Scene
from scene import make_body, make_camera
from timing import time_once, time_runs

FLOP_PER_FRAGMENT = 36
"""Forward, counted by hand: offset, exponent, exp, alpha, transmittance (28), four blended channels (8)."""
COUNTED = (
    "fragments = pairs of a pixel and a Gaussian with alpha >= 1/255 (those behind the pixel's early stop "
    f"included), {FLOP_PER_FRAGMENT} FLOP each, over the whole forward pass (projection, sorting and binning "
    "included); lanes computed for nothing do not count; peak = float32 multiply-adds in cache, 2 FLOP each"
)
HEADLINE = ("torch tiles", 20_000, 256, 256)
SAME_IMAGE = 1e-4
"""Largest difference of a colour that `torch tiles` may have from the reference."""
LEAST_PSNR_DB = 25.0
"""A rival whose image is further from ours draws something else, and its time says nothing."""


@dataclass(frozen=True)
class Plan:
    """What one run of the benchmark measures."""

    sizes: tuple[tuple[int, int, int], ...]
    """Gaussians, width, height; those with less work first."""
    seconds: float
    """Time for each measurement."""
    most_runs: int
    """Runs after which a measurement ends, if its time is not over."""
    slowest_s: float
    """A pass that takes longer than this is left out."""
    peak_repeats: int
    stage_repeats: int
    threads: tuple[int, ...]


FULL = Plan(
    sizes=(
        (5_000, 256, 256),
        (20_000, 256, 256),
        (50_000, 256, 256),
        (200_000, 256, 256),
        (5_000, 320, 448),
        (20_000, 320, 448),
        (50_000, 320, 448),
        (200_000, 320, 448),
        (5_000, 940, 1280),
        (20_000, 940, 1280),
        (50_000, 940, 1280),
        (200_000, 940, 1280),
    ),
    seconds=1.5,
    most_runs=100,
    slowest_s=8,
    peak_repeats=10,
    stage_repeats=20,
    threads=(1, 2),
)
QUICK = Plan(
    sizes=((5_000, 96, 128), (20_000, 256, 256)),
    seconds=0.3,
    most_runs=30,
    slowest_s=1.5,
    peak_repeats=3,
    stage_repeats=10,
    threads=(2,),
)
PASSES = ("forward", "forward_backward")


def use_threads(count: int) -> None:
    """Let our kernels and torch use this many threads; other rivals are told when they get their scene."""
    numba.set_num_threads(count)
    torch.set_num_threads(count)


def find_rivals(quick: bool) -> list[dict]:
    """Say of each rival whether it is here, and whether its image is the one it should draw."""
    size = (2_000, 96, 128) if quick else (5_000, 256, 256)
    gaussians, camera = make_body(size[0]), make_camera(*size[1:])
    scene = OURS.prepare(gaussians, camera, 1)
    # Compiles or loads our kernels, which belongs to no measurement.
    scene.forward_backward()
    ours = scene.image()
    reference = next(rival for rival in RIVALS if rival.name == "reference")
    reference = reference.prepare(gaussians, camera, 1).image()
    found = []
    for rival in RIVALS:
        entry = {"name": rival.name, "about": rival.about, "version": None, "psnr_db": None, "skipped": None}
        found.append(entry)
        if not rival.is_installed():
            entry["skipped"] = f"not installed: pip install -c constraints.txt {rival.package}"
            continue
        try:
            image = rival.prepare(gaussians, camera, 1).image()
        except ImportError as error:
            entry["skipped"] = f"does not load here: {error}"
            continue
        entry["version"] = rival.version()
        entry["psnr_db"] = psnr = float(-10 * np.log10(np.mean((image - ours) ** 2)))
        if psnr < LEAST_PSNR_DB:
            entry["skipped"] = f"its image is {psnr:.1f} dB from ours, less than {LEAST_PSNR_DB} dB"
        if rival.name == "torch tiles":
            difference = np.abs(image - reference).max()
            assert difference <= SAME_IMAGE, f"torch tiles differ from the reference by {difference}"
    return found


class Measurer:
    """Times rasterisers from small scenes to large, and leaves out what would take too long."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._seconds_per_pair: dict[tuple[str, int, str], float] = {}

    def measure(self, rival: Rival, size: tuple[int, int, int], threads: int, work: Work) -> list[dict]:
        """Return one row for each pass of a rasteriser over a scene."""
        use_threads(threads)
        scene = None
        rows = []
        for name in PASSES:
            row = dict(zip(("gaussians", "width", "height"), size, strict=True))
            row = {"rasteriser": rival.name, **row, "threads": threads, "pass": name, "skipped": None}
            row["skipped"] = self._find_obstacle(rival, threads, name, work)
            if not row["skipped"]:
                scene = scene or rival.prepare(make_body(size[0]), make_camera(*size[1:]), threads)
                row |= self._time(rival, scene, threads, name, work)
            rows.append(row)
            gc.collect()
        return rows

    def _find_obstacle(self, rival: Rival, threads: int, name: str, work: Work) -> str | None:
        """Return why a pass is not worth trying, judged by the scene before."""
        seconds = self._seconds_per_pair.get((rival.name, threads, name), 0) * work.tile_pairs
        if seconds > self._plan.slowest_s:
            return f"would take about {seconds:.1f} s a run, more than {self._plan.slowest_s:g} s"
        needed, memory = rival.bytes_per_pair * work.tile_pairs, count_memory()
        if name == "forward_backward" and memory and needed > memory / 2:
            return f"would keep about {needed / 2**30:.0f} GiB, more than half of the memory"
        return None

    def _time(self, rival: Rival, scene: Scene, threads: int, name: str, work: Work) -> dict:
        """Return the timing of one pass, after a run that does not count."""
        function = getattr(scene, name)
        first = time_once(function)
        if first > self._plan.slowest_s:
            self._seconds_per_pair[rival.name, threads, name] = first / work.tile_pairs
            return {
                "skipped": f"one run took {first:.1f} s (the first), more than {self._plan.slowest_s:g} s"
            }
        timing = time_runs(function, self._plan.seconds, self._plan.most_runs)
        self._seconds_per_pair[rival.name, threads, name] = 1e-3 * timing.median_ms / work.tile_pairs
        return asdict(timing)


def run(plan: Plan, threads: list[int], rivals: list[Rival]) -> tuple[list[dict], list[dict]]:
    """Measure everything; return the rows and what each scene asks for."""
    measurer = Measurer(plan)
    rows, scenes = [], []
    for size in plan.sizes:
        work = count_work(make_body(size[0]), make_camera(*size[1:]))
        scenes.append(dict(zip(("gaussians", "width", "height"), size, strict=True)) | asdict(work))
        for count in threads:
            for rival in (OURS, *rivals):
                for row in measurer.measure(rival, size, count, work):
                    rows.append(row)
                    print(describe_row(row), flush=True)
    return rows, scenes


def find_ratios(rows: list[dict]) -> list[dict]:
    """Return how many times as fast as each rival ours is, where both were timed."""
    same = ("gaussians", "width", "height", "threads", "pass")
    ours = {tuple(row[key] for key in same): row for row in rows if row["rasteriser"] == OURS.name}
    ratios = []
    for row in rows:
        if row["rasteriser"] != OURS.name and not row["skipped"]:
            case = {key: row[key] for key in same}
            ratio = row["median_ms"] / ours[tuple(case.values())]["median_ms"]
            ratios.append({"rival": row["rasteriser"], **case, "ratio": ratio})
    return ratios


def find_arithmetic(rows: list[dict], scenes: list[dict], peaks: dict[int, float]) -> list[dict]:
    """Return what our forward pass computes in a second, beside what the processor could."""
    found = []
    for row in rows:
        if row["rasteriser"] != OURS.name or row["pass"] != "forward":
            continue
        case = {key: row[key] for key in ("gaussians", "width", "height")}
        scene = next(scene for scene in scenes if case.items() <= scene.items())
        rate = 1e3 * scene["fragments"] / row["median_ms"]
        gflops = 1e-9 * FLOP_PER_FRAGMENT * rate
        share = gflops / peaks[row["threads"]]
        blended = scene["blended"] / scene["fragments"]
        found.append({**case, "threads": row["threads"], "fragments_per_s": rate, "gflops": gflops})
        found[-1] |= {"share_of_peak": share, "share_of_peak_blended": share * blended}
    return found


def find_stages(plan: Plan, threads: list[int], peaks: dict[int, float]) -> list[dict]:
    """Return where our time goes, kernel by kernel."""
    found = []
    for size in plan.sizes:
        for count in threads:
            use_threads(count)
            stages = measure_kernels(make_body(size[0]), make_camera(*size[1:]), plan.stage_repeats)
            case = dict(zip(("gaussians", "width", "height"), size, strict=True)) | {"threads": count}
            share = {name: rate / peaks[count] for name, rate in stages.gflops.items()}
            found.append(case | asdict(stages) | {"share_of_peak": share})
    return found


def main() -> None:
    """Measure, print, and write what was found."""
    parser = argparse.ArgumentParser(description="Time the CPU rasteriser against others.")
    parser.add_argument("--quick", action="store_true", help="under a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    parser.add_argument("--chart", type=Path, metavar="DIR", help="draw charts as PNG (needs matplotlib)")
    arguments = parser.parse_args()
    if arguments.chart and not importlib.util.find_spec("matplotlib"):
        parser.error("--chart needs matplotlib: pip install -c constraints.txt matplotlib")
    plan = QUICK if arguments.quick else FULL
    threads = sorted({min(count, numba.config.NUMBA_NUM_THREADS) for count in plan.threads})
    found = {"command": shlex.join(["python", *sys.argv]), **describe_machine(), "threads": threads}
    found |= {"load_before": read_load(), "counted": COUNTED, "not_compared": NOT_COMPARED}
    found["rivals"] = find_rivals(arguments.quick)
    print(*map(describe_rival, found["rivals"]), sep="\n")
    fit = {entry["name"] for entry in found["rivals"] if not entry["skipped"]}
    peaks = {count: measure_peak(count, plan.peak_repeats) for count in threads}
    rows, scenes = run(plan, threads, [rival for rival in RIVALS if rival.name in fit])
    found |= {"peak_gflops": peaks, "rows": rows, "scenes": scenes, "ratios": find_ratios(rows)}
    found |= {"arithmetic": find_arithmetic(rows, scenes, peaks)}
    found |= {"stages": find_stages(plan, threads, peaks), "load_after": read_load()}
    if arguments.json:
        write_json(found, arguments.json)
    if arguments.chart:
        # Here, not above: the benchmark needs matplotlib for nothing else.
        from charts import draw_charts

        draw_charts(rows, found["ratios"], OURS.name, arguments.chart)
    print(*(f"Peak, {count} thread(s): {peak:.0f} GFLOP/s" for count, peak in peaks.items()), sep="\n")
    print(f"Counted: {COUNTED}", *map(describe_arithmetic, found["arithmetic"]), sep="\n")
    print(*map(describe_stages, found["stages"]), sep="\n")
    best = [r for r in found["ratios"] if r["threads"] == threads[-1] and r["pass"] == "forward_backward"]
    for ratio in sorted(best, key=is_headline):
        print(describe_ratio(ratio))


def is_headline(ratio: dict) -> bool:
    """Tell whether a ratio is the one to quote."""
    return tuple(ratio[key] for key in ("rival", "gaussians", "width", "height")) == HEADLINE


if __name__ == "__main__":
    main()
