"""How fast, how large and how steady USD export is, against a naive writer and against fourdgs.

    python benchmarks/export.py --json benchmarks/results/export.json

All Gaussians change in every frame, in every field. `ours` is what `dsar export --usd` does: two schemas,
three levels of detail, validation and all. `usd-core` sets the same arrays, made before, and saves: no writer
over it can be faster. The rivals write one prim a Gaussian (`naive`) and one Gaussian field (`fourdgs`: its
animated to_usd). The memory of long exports is read in processes of their own.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from machine import describe_machine, read_load
from results import write_json

from dsar.body.files import load_body
from dsar.body.model import JOINT_NAMES
from dsar.geometry.rotations import matrix_from_axis_angle
from dsar.types import Binding, Gaussians, GaussianSequence
from dsar_exporters import UsdAsset, export

FPS = 24.0
_ROUNDS = 5


def make_sequence(count: int, frames: int) -> GaussianSequence:
    """Return Gaussians that all change, moved in every frame from noise made once, on a body that turns."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(count, 20, generator=generator)

    def produce() -> Iterator[Gaussians]:
        for frame in range(frames):
            at = noise + 0.01 * frame
            yield Gaussians(
                means=at[:, :3].contiguous(),
                rotations=torch.nn.functional.normalize(at[:, 3:7], dim=-1),
                scales=0.01 * (at[:, 7:10].abs() + 0.1),
                opacities=at[:, 10].sigmoid(),
                harmonics=at[:, None, 11:14].contiguous(),
            )

    binding = bind(noise[:, :3].contiguous(), frames)
    return GaussianSequence(range(1001, 1001 + frames), FPS, count, produce, binding=binding)


def bind(points: torch.Tensor, frames: int) -> Binding:
    """Return points that hang on the pelvis of the embedded body, which turns once in a hundred frames."""
    body = load_body()
    angle = torch.arange(frames) * (2 * torch.pi / 100)
    turns = matrix_from_axis_angle(torch.stack([0 * angle, angle, 0 * angle], -1))
    transforms = torch.eye(4).repeat(frames, len(JOINT_NAMES), 1, 1)
    transforms[:, :, :3, :3] = turns[:, None]
    weights = torch.zeros(len(points), len(JOINT_NAMES))
    weights[:, 0] = 1
    return Binding(body, JOINT_NAMES, points, weights, torch.zeros(len(points), 2), transforms)


def write_ours(sequence: GaussianSequence, folder: Path, *, half: bool = False) -> dict:
    """Write an asset; return seconds in the writer, bytes of the payload and of the values in it."""
    output = UsdAsset(folder / "ours.usda", "avatar", half=half)
    (delivered,) = export(sequence, [output])
    payload = folder / "ours.payload.usdc"
    distinct, every = count_values(payload)
    size = payload.stat().st_size
    return {
        "seconds": delivered.seconds,
        "payload_bytes": size,
        "payload_mb_per_s": size / delivered.seconds / 1e6,
        "payload_over_attribute_bytes": size / every,
        "payload_over_distinct_attribute_bytes": size / distinct,
    }


def count_values(path: Path) -> tuple[int, int]:
    """Return the bytes of a file's distinct values, and of all attributes' values."""
    from pxr import Sdf

    layer, seen, distinct, every = Sdf.Layer.FindOrOpen(str(path)), set(), 0, 0

    def visit(spec_path: Sdf.Path) -> None:
        nonlocal distinct, every
        if not spec_path.IsPropertyPath():
            return
        for sample in layer.ListTimeSamplesForPath(spec_path):
            blob = np.ascontiguousarray(layer.QueryTimeSample(spec_path, sample)).tobytes()
            every += len(blob)
            digest = hashlib.blake2b(blob, digest_size=16).digest()
            if digest not in seen:
                seen.add(digest)
                distinct += len(blob)

    layer.Traverse("/", visit)
    return distinct, every


def write_bound(source: Path, folder: Path) -> dict:
    """Set the values of a written payload in a new layer, and save it: usd-core's own time."""
    from pxr import Sdf

    layer = Sdf.Layer.FindOrOpen(str(source))
    copy = Sdf.Layer.CreateNew(str(folder / "bound.usdc"))
    samples: dict[float, list] = {}

    def visit(spec_path: Sdf.Path) -> None:
        if spec_path.IsPropertyPath() and layer.GetNumTimeSamplesForPath(spec_path):
            spec = layer.GetAttributeAtPath(spec_path)
            Sdf.JustCreatePrimAttributeInLayer(copy, spec_path, spec.typeName)
            for sample in layer.ListTimeSamplesForPath(spec_path):
                samples.setdefault(sample, []).append(spec_path)

    layer.Traverse("/", visit)
    seconds = 0.0
    for index, sample in enumerate(sorted(samples), start=1):
        values = [(path, layer.QueryTimeSample(path, sample)) for path in samples[sample]]
        # Values of a crate lie on disk until they are touched.
        values = [(path, type(value)(value)) for path, value in values]
        began = time.perf_counter()
        for path, value in values:
            copy.SetTimeSample(path, sample, value)
        if index % 32 == 0:
            copy.Save()
        seconds += time.perf_counter() - began
    began = time.perf_counter()
    copy.Save()
    seconds += time.perf_counter() - began
    size = (folder / "bound.usdc").stat().st_size
    return {"seconds": seconds, "payload_bytes": size, "payload_mb_per_s": size / seconds / 1e6}


def write_naive(sequence: GaussianSequence, folder: Path) -> dict:
    """Write a sphere a Gaussian, each with a transform and a colour of its own."""
    from pxr import Gf, Usd, UsdGeom

    began = time.perf_counter()
    stage = Usd.Stage.CreateNew(str(folder / "naive.usdc"))
    prims = [UsdGeom.Sphere.Define(stage, f"/a/g{i}") for i in range(sequence.num_gaussians)]
    moves = [prim.AddTranslateOp() for prim in prims]
    turns = [prim.AddOrientOp() for prim in prims]
    sizes = [prim.AddScaleOp() for prim in prims]
    looks = [prim.CreateDisplayColorAttr() for prim in prims]
    for frame, gaussians in sequence:
        rows = [each.tolist() for each in (gaussians.means, gaussians.rotations, gaussians.scales)]
        colors = gaussians.harmonics[:, 0].tolist()
        for i, (place, turn, size) in enumerate(zip(*rows, strict=True)):
            moves[i].Set(Gf.Vec3d(*place), frame)
            turns[i].Set(Gf.Quatf(*turn), frame)
            sizes[i].Set(Gf.Vec3f(*size), frame)
            looks[i].Set([Gf.Vec3f(*colors[i])], frame)
    stage.Save()
    seconds = time.perf_counter() - began
    return {"seconds": seconds, "bytes": (folder / "naive.usdc").stat().st_size}


def write_fourdgs(sequence: GaussianSequence, folder: Path) -> dict:
    """Write with fourdgs: every frame's Gaussians live for one frame."""
    import fourdgs

    frames = [gaussians for _, gaussians in sequence]
    count, total = sequence.num_gaussians, sequence.num_gaussians * len(frames)
    begins = np.repeat(np.arange(len(frames)) / FPS, count)
    colors = [np.concatenate([g.harmonics[:, 0] * 0.2821 + 0.5, g.opacities[:, None]], 1) for g in frames]
    scene = fourdgs.GaussianSet(
        positions=np.concatenate([g.means.numpy() for g in frames]),
        scales=np.concatenate([g.scales.numpy() for g in frames]),
        rotations=np.concatenate([g.rotations.numpy()[:, [1, 2, 3, 0]] for g in frames]),
        colors=np.concatenate(colors).astype(np.float32),
        motions=np.zeros((total, 3), np.float32),
        mu_t=begins.astype(np.float32),
        sigma_t=np.full(total, np.inf, np.float32),
        win_lo=begins - 0.5 / FPS,
        win_hi=begins + 0.5 / FPS,
    )
    began = time.perf_counter()
    fourdgs.to_usd(
        str(folder / "fourdgs.usdc"),
        scene,
        0.0,
        cutoff=0.05,
        coordinate_system="y-up-right-handed",
        animated=True,
        fps=FPS,
        duration_sec=(len(frames) - 1) / FPS,
    )
    seconds = time.perf_counter() - began
    return {"seconds": seconds, "bytes": (folder / "fourdgs.usdc").stat().st_size}


def measure_memory(count: int, frames: int, clips: bool) -> dict:
    """Export in a process of its own and return its resident memory in MB, every tenth of the way."""
    command = [sys.executable, __file__, "--long", str(count), str(frames), "clips" if clips else "payload"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def run_long(count: int, frames: int, kind: str) -> None:
    """Export, and print what `measure_memory` returns."""
    sequence, seen = make_sequence(count, frames), []

    def produce() -> Iterator[Gaussians]:
        for index, gaussians in enumerate(sequence.produce()):
            if index % max(frames // 10, 1) == 0:
                seen.append(resident_mb())
            yield gaussians

    with tempfile.TemporaryDirectory() as folder:
        output = UsdAsset(Path(folder) / "long.usda", "avatar", clips=kind == "clips")
        watched = dataclasses.replace(sequence, produce=produce)
        (delivered,) = export(watched, [output])
    found = {
        "gaussians": count,
        "frames": frames,
        "bytes": delivered.size,
        "resident_mb": seen,
        # The most at any time, closing and checking the asset included.
        "peak_mb": peak_mb(),
    }
    print(json.dumps(found))


def resident_mb() -> float:
    """Return this process's memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def peak_mb() -> float:
    """Return the most memory that this process ever had; getrusage would count its parent's, too."""
    (line,) = [
        each for each in Path("/proc/self/status").read_text().splitlines() if each.startswith("VmHWM")
    ]
    return int(line.split()[1]) / 1e3


def main() -> None:
    """Measure, print, and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="smaller sizes, under a minute")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--long", nargs=3, metavar=("COUNT", "FRAMES", "KIND"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.long:
        run_long(int(options.long[0]), int(options.long[1]), options.long[2])
        return
    size, small, long = (
        ((2000, 24), (200, 12), (100, 200)) if options.quick else ((20_000, 240), (5000, 48), (200, 10_000))
    )
    found: dict = {"machine": describe_machine(), "load_before": read_load()}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found["gaussians"], found["frames"] = size
        # In turn, so that both meet the same machine and disk.
        rounds = []
        for _ in range(_ROUNDS):
            ours = write_ours(make_sequence(*size), folder)
            rounds.append((ours, write_bound(folder / "ours.payload.usdc", folder)))
            (folder / "bound.usdc").unlink()
        found["ours"], found["usd_core"] = (
            sorted(each, key=lambda one: one["seconds"])[_ROUNDS // 2] for each in zip(*rounds, strict=True)
        )
        found["ratios_by_round"] = [ours["seconds"] / bound["seconds"] for ours, bound in rounds]
        found["ours_half"] = write_ours(make_sequence(*size), folder, half=True)
    writers: dict[str, Callable] = {"ours": write_ours, "naive": write_naive, "fourdgs": write_fourdgs}
    found["rivals"] = {"gaussians": small[0], "frames": small[1]}
    for rival, write in writers.items():
        with tempfile.TemporaryDirectory() as name:
            found["rivals"][rival] = write(make_sequence(*small), Path(name))
    found["memory"] = {kind: measure_memory(*long, clips=kind == "clips") for kind in ("payload", "clips")}
    found["load_after"] = read_load()
    print(json.dumps({key: value for key, value in found.items() if key != "machine"}, indent=1))
    if options.json:
        write_json(found, options.json)
    ours, rivals, ratios = found["ours"], found["rivals"], sorted(found["ratios_by_round"])
    print(f"payload over distinct attribute bytes: {ours['payload_over_distinct_attribute_bytes']:.2f}")
    print(f"our time over usd-core's alone: {ratios[_ROUNDS // 2]:.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f})")
    for rival in ("naive", "fourdgs"):
        ratio = rivals[rival]["seconds"] / rivals["ours"]["seconds"]
        print(f"{rival}'s time over ours: {ratio:.2f}")


if __name__ == "__main__":
    main()
