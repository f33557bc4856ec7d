"""How fast the network is in each wiring, against the paper's literal design, in the same run.

    python benchmarks/network.py [--quick] [--json FILE] [--chart DIR] [--device cpu|cuda]

`rollout` is one frame of one person, without gradients, as in rendering and export; `training` is one
frame of a batch of rollouts with its backward pass (truncated after one frame), per rollout. The literal
design (tests/literal_network.py) encodes all n frames at every step with the newest offsets, computes all
rows of the attention, and doubles maps before it convolves them. Inputs are random: no network here runs
faster for what it sees. GFLOP are those of convolutions and matrix products.
"""

# First, because it imports torch before dsar does; see raster.py.
from machine import describe_machine, read_load  # isort: skip

import argparse
import dataclasses
import importlib.util
import shlex
import statistics
import sys
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import torch
from results import write_json
from timing import Timing, time_together
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from dsar.config import PRESETS, ModelConfig
from dsar.evaluation.parts import count_parts, read_clock, time_parts
from dsar.network import DualStreamNetwork, NetworkOutput
from dsar.network.streaming import Rollout

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from literal_network import LiteralNetwork, LiteralRollout

LITERAL = "literal"
WIRINGS = ("shared", "late", "perframe")
HEADLINE = ("demo", 10)


@dataclass(frozen=True)
class Case:
    """A size of the network."""

    preset: str
    window: int
    """Frames n; the bank holds as many."""
    size: tuple[int, int]
    """Height and width of its maps."""
    batch: int
    """Rollouts of a step of training."""

    def config(self, wiring: str) -> ModelConfig:
        """Return the preset's network with this window and wiring."""
        changes = {"wiring": wiring, "window": self.window, "memory": self.window}
        return dataclasses.replace(PRESETS[self.preset].model, **changes)


# Maps of the embedded capture: the body's square and the garment's rows beneath it, 8 (4) texels a pixel.
DEMO, SMALL, PAPER = (16, 12), (48, 32), (512, 512)
CASES = (
    Case("demo", 5, DEMO, 64),
    Case("demo", 10, DEMO, 64),
    Case("small", 10, SMALL, 16),
    Case("paper", 10, PAPER, 1),
)
QUICK = (Case("demo", 10, DEMO, 64),)


@dataclass(frozen=True)
class Subject:
    """One design at one size, ready to be timed."""

    network: DualStreamNetwork
    """What `rollout` runs."""
    rollout: Callable[[], NetworkOutput]
    """Computes the next frame."""
    training: Callable[[], None]
    """Computes a step's gradients."""


def build(case: Case, design: str, device: str) -> Subject:
    """Return a design with random weights and inputs."""
    torch.manual_seed(0)
    config = case.config("shared" if design == LITERAL else design)
    network = DualStreamNetwork(config, torch.ones(case.size, dtype=torch.bool)).to(device)
    torch.nn.init.normal_(network.decoder.head.weight, std=0.01)
    if design == LITERAL:
        literal = LiteralNetwork(network).to(device)
        return Subject(network, _roll(LiteralRollout(literal), config, case, device),
                       partial(_train_literal, literal, *_draw(config, case, device)))  # fmt: skip
    rollout = Rollout(network, precision=torch.bfloat16 if device == "cuda" else None)
    return Subject(rollout.network, _roll(rollout, config, case, device),
                   partial(_train, network, *_draw(config, case, device)))  # fmt: skip


def _roll(rollout: Rollout | LiteralRollout, config: ModelConfig, case: Case, device: str) -> Callable:
    """Return a function that advances one person, whose window is full already."""
    maps = torch.randn(1, config.map_channels, *case.size, device=device)
    magnitude = torch.rand(1, 1, *case.size, device=device)

    @torch.no_grad()
    def step() -> NetworkOutput:
        return rollout.step(maps, magnitude)

    for _ in range(config.window + 1):
        step()
    return step


def _draw(config: ModelConfig, case: Case, device: str) -> tuple[Tensor, Tensor]:
    shape = (config.window, case.batch)
    maps = torch.randn(*shape, config.map_channels, *case.size, device=device)
    return maps, torch.rand(*shape, 1, *case.size, device=device)


def _train(network: DualStreamNetwork, maps: Tensor, magnitudes: Tensor) -> None:
    """Back-propagate one step, from a state that was carried on."""
    state = network.start(maps.shape[1])
    state = dataclasses.replace(state, fresh=torch.zeros_like(state.fresh))
    output, _ = network(maps[-1], magnitudes[-1], state)
    _backward(network, output)


def _train_literal(literal: LiteralNetwork, maps: Tensor, magnitudes: Tensor) -> None:
    config, batch = literal.network.config, maps.shape[1]
    state = literal.network.start(batch)
    offsets = [state.offsets.flatten(1, 2)] * config.window
    output, _ = literal(list(maps), list(magnitudes), offsets, list(state.memory.unbind(1)))
    _backward(literal, output)


def _backward(module: torch.nn.Module, output: NetworkOutput) -> None:
    module.zero_grad()
    (output.offset.sum() + output.appearance.sum()).backward()


def measure(case: Case, device: str, seconds: float) -> list[dict]:
    """Return a row for each design and pass, all designs timed in turn."""
    subjects = {design: build(case, design, device) for design in (LITERAL, *WIRINGS)}
    rows = []
    for name, batch in (("rollout", 1), ("training", case.batch)):
        same = {"preset": case.preset, "window": case.window, "pass": name, "batch": batch}
        same |= {"map_height": case.size[0], "map_width": case.size[1], "skipped": None}
        made = [{"design": design, **same} for design in subjects]
        rows += made
        if device == "cpu" and case.preset == "paper" and name == "training":
            for row in made:
                row["skipped"] = "on a CPU: minutes a step"
            continue
        functions = [partial(_finish, getattr(subject, name)) for subject in subjects.values()]
        for function in functions:
            function()
        for row, timing in zip(made, time_together(functions, seconds, 400), strict=True):
            row |= _per_rollout(timing, batch)
        if device == "cpu":
            for row, (design, subject) in zip(made, subjects.items(), strict=True):
                row |= _take_apart(subject, name, batch, whole=design == LITERAL)
    return rows


def _finish(function: Callable[[], object]) -> None:
    """Run a function, and wait for the GPU."""
    function()
    read_clock()


def _take_apart(subject: Subject, name: str, batch: int, *, whole: bool) -> dict:
    """Return GFLOP and, of our rollouts, milliseconds, by part."""
    if whole or name == "training":
        with FlopCounterMode(display=False) as counter:
            getattr(subject, name)()
        return {"gflop": {"total": 1e-9 * counter.get_total_flops() / batch}}
    return {"gflop": count_parts(subject.network, subject.rollout), "parts_ms": _parts(subject)}


def _per_rollout(timing: Timing, batch: int) -> dict:
    values = asdict(timing)
    return {key: value / batch if key.endswith("_ms") else value for key, value in values.items()}


def _parts(subject: Subject, repeats: int = 10) -> dict[str, float]:
    """Return the median milliseconds of a rollout's frame by part."""
    found = defaultdict(list)
    for _ in range(repeats):
        for name, milliseconds in time_parts(subject.network, subject.rollout)[1].items():
            found[name].append(milliseconds)
    return {name: statistics.median(values) for name, values in found.items()}


def find_ratios(rows: list[dict]) -> list[dict]:
    """Return how many times as fast each design is as the literal one."""
    same = ("preset", "window", "pass")
    literal = {tuple(r[key] for key in same): r for r in rows if r["design"] == LITERAL and not r["skipped"]}
    ratios = []
    for row in rows:
        case = tuple(row[key] for key in same)
        if row["design"] != LITERAL and not row["skipped"] and case in literal:
            ratio = literal[case]["median_ms"] / row["median_ms"]
            ratios.append({"design": row["design"], **dict(zip(same, case, strict=True)), "ratio": ratio})
    return ratios


def describe(row: dict) -> str:
    """Return a row in words."""
    case = f"{row['design']:9} {row['preset']:6} n={row['window']:<3} {row['pass']:9}"
    if row["skipped"]:
        return f"{case} skipped: {row['skipped']}"
    spread = f"{row['low_ms']:.2f} - {row['high_ms']:.2f}"
    text = f"{case} {row['median_ms']:9.2f} ms ({spread}, {row['runs']} runs, batch {row['batch']})"
    if "gflop" in row:
        text += f", {row['gflop']['total']:.3f} GFLOP"
    if "parts_ms" in row:
        text += "; " + ", ".join(f"{name} {ms:.2f}" for name, ms in row["parts_ms"].items())
    return text


def main() -> None:
    """Measure, print, and write what was found."""
    parser = argparse.ArgumentParser(description="Time the network's wirings against the paper's design.")
    parser.add_argument("--quick", action="store_true", help="under a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    parser.add_argument("--chart", type=Path, metavar="DIR", help="draw a chart as PNG (needs matplotlib)")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to run")
    parser.add_argument(
        "--threads", type=int, default=1, help="threads on a CPU; a worker of training has one"
    )
    arguments = parser.parse_args()
    if arguments.chart and not importlib.util.find_spec("matplotlib"):
        parser.error("--chart needs matplotlib: pip install -c constraints.txt matplotlib")
    torch.set_num_threads(arguments.threads)
    found = {"command": shlex.join(["python", *sys.argv]), **describe_machine(), "load_before": read_load()}
    found |= {"device": arguments.device, "threads": arguments.threads}
    if arguments.device == "cuda":
        found["gpu"] = torch.cuda.get_device_name()
        # What the paper's literal design would use in PyTorch.
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    rows = []
    for case in QUICK if arguments.quick else CASES:
        for row in measure(case, arguments.device, 4.0 if arguments.quick else 20.0):
            rows.append(row)
            print(describe(row), flush=True)
    found |= {"rows": rows, "ratios": find_ratios(rows), "load_after": read_load()}
    if arguments.json:
        write_json(found, arguments.json)
    if arguments.chart:
        # Here, not above: the benchmark needs matplotlib for nothing else.
        from network_charts import draw_chart

        draw_chart(rows, arguments.chart / f"network_{arguments.device}.png")
    default = ModelConfig().wiring
    for ratio in sorted(found["ratios"], key=lambda r: (r["preset"], r["window"]) == HEADLINE):
        mark = " (the default)" if ratio["design"] == default else ""
        case = f"{ratio['pass']}, {ratio['preset']}, n={ratio['window']}"
        print(f"{ratio['design']}{mark} is {ratio['ratio']:.2f}x as fast as the literal design, {case}")


if __name__ == "__main__":
    main()
