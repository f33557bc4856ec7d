"""What a GPU does: rasterisers, network, whole frames and training, in one run of under ten minutes.

    python benchmarks/gpu.py [--quick] [--json FILE] [--chart DIR] [--device auto|cpu|cuda|cuda:N]

Every section runs in a process of its own, so that one that fails spoils no other; the file is written anew
after every row, so that a run which is cut keeps what it has. gsplat comes last, because its first image
compiles it for minutes; where Warp is not installed it comes before whole frames, which it then draws.
`python tools/pack_gpu_benchmark.py DIR` collects what the run needs on a machine without a network.
Nothing here compares with figures of another machine; the CPU's updates are measured on this one, too.
"""

# First, because it imports torch before dsar does; see raster.py.
from machine import describe_machine, read_load  # isort: skip

import argparse
import importlib.util
import multiprocessing
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from gpu_frame import measure_frame
from gpu_network import measure_network
from gpu_raster import find_obstacle, measure_gsplat, measure_parity, measure_raster
from gpu_report import describe_row, find_ratios
from gpu_training import measure_cpu_training, measure_training
from isolated import SectionError, stream_isolated
from results import write_json

from dsar.devices import choose_device

WHOLE_SECONDS = 570.0
"""After so long a run begins nothing, and stops what it does."""


@dataclass(frozen=True)
class Section:
    """A part of the run."""

    measure: Callable[[bool, str], Iterator[dict]]
    """Yields rows; is told whether to be quick, and the name of the device."""
    seconds: float
    """The longest that it may take."""


def describe_device(quick: bool, device: str) -> Iterator[dict]:
    """Yield what is measured: the device, its memory and driver."""
    del quick
    where = choose_device(device)
    row: dict = {"device": str(where), "skipped": None}
    if where.type == "cuda":
        properties = torch.cuda.get_device_properties(where)
        row |= {"gpu": properties.name, "memory_bytes": properties.total_memory}
        row |= {"multiprocessors": properties.multi_processor_count}
        row |= {"architecture": f"sm_{properties.major}{properties.minor}"}
        row |= {"cuda": torch.version.cuda, "cudnn": torch.backends.cudnn.version()}
    yield row


SECTIONS = {
    "device": Section(describe_device, 60),
    "parity": Section(measure_parity, 90),
    "raster": Section(measure_raster, 90),
    "network": Section(measure_network, 180),
    "frame": Section(measure_frame, 90),
    "training": Section(measure_training, 180),
    "cpu training": Section(measure_cpu_training, 120),
    "gsplat": Section(measure_gsplat, 400),
}


def order_sections() -> list[str]:
    """Return the sections in their order; without Warp, gsplat is compiled before it draws whole frames."""
    names = [name for name in SECTIONS if name != "gsplat"]
    place = len(names) if find_obstacle("warp") is None else names.index("frame")
    return [*names[:place], "gsplat", *names[place:]]


def run_section(section: Section, quick: bool, device: str, seconds: float) -> Iterator[tuple[str, dict]]:
    """Yield `rows` with each row, and last `reason` where the section did not end well."""
    if seconds <= 0:
        yield "reason", {"reason": "no time was left"}
        return
    try:
        for row in stream_isolated(section.measure, (quick, device), min(seconds, section.seconds)):
            yield "rows", row
    except SectionError as error:
        yield "reason", {"reason": str(error)}


def run(quick: bool, device: str, found: dict, keep: Callable[[], None]) -> None:
    """Run all sections, adding to what was found; `keep` is called whenever there is more."""
    began = time.monotonic()
    for name in order_sections():
        section, start = SECTIONS[name], time.monotonic()
        entry: dict = {"rows": [], "failed": None}
        found["sections"][name] = entry
        for kind, value in run_section(section, quick, device, WHOLE_SECONDS - (start - began)):
            if kind == "rows":
                entry["rows"].append(value)
                print(describe_row(name, value), flush=True)
            else:
                entry["failed"] = value["reason"]
                print(f"{name}: FAILED, {value['reason']}", flush=True)
            keep()
        entry["seconds"] = time.monotonic() - start
        keep()


def main() -> None:
    """Measure, print, and write what was found."""
    parser = argparse.ArgumentParser(description="Measure what a GPU does, in under ten minutes.")
    parser.add_argument("--quick", action="store_true", help="all sections, tiny, in under a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found, row by row")
    parser.add_argument("--chart", type=Path, metavar="DIR", help="draw a chart as PNG (needs matplotlib)")
    parser.add_argument("--device", help="auto, cpu, cuda or cuda:N; auto, or cpu with --quick, if left out")
    arguments = parser.parse_args()
    if "fork" not in multiprocessing.get_all_start_methods():
        parser.error("this system cannot fork processes, which sections need: run it on Linux")
    if arguments.chart and not importlib.util.find_spec("matplotlib"):
        parser.error("--chart needs matplotlib: pip install -c constraints.txt matplotlib")
    device = arguments.device or ("cpu" if arguments.quick else "auto")
    found = {"command": shlex.join(["python", *sys.argv]), **describe_machine(), "load_before": read_load()}
    found |= {"quick": arguments.quick, "sections": {}}

    def keep() -> None:
        found["ratios"] = find_ratios(found["sections"])
        if arguments.json:
            write_json(found, arguments.json)

    run(arguments.quick, device, found, keep)
    found["load_after"] = read_load()
    keep()
    if arguments.chart:
        # Here, not above: the benchmark needs matplotlib for nothing else.
        from gpu_chart import draw_chart

        draw_chart(found["sections"], arguments.chart / "gpu.png")
    for ratio in found["ratios"]:
        print(f"{ratio['what']}: {ratio['value']:.2f} {ratio['unit']}")
    failed = [name for name, entry in found["sections"].items() if entry["failed"]]
    rows = [row for entry in found["sections"].values() for row in entry["rows"]]
    failed += [f"{row['backend']} ({row['scene']})" for row in rows if not row.get("agrees", True)]
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
