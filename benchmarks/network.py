"""How fast the network is in each wiring, against the paper's literal design, in the same run.

    python benchmarks/network.py [--quick] [--json FILE] [--chart DIR] [--device cpu|cuda] [--paper]

`rollout` is one frame of one person, without gradients, as in rendering and export; `frame` is that with
everything around it, from the bones to an image of the embedded capture's person; `training` is one
frame of a batch of rollouts with its backward pass (truncated after one frame), per rollout. The literal
design (`dsar.network.reference`) encodes all n frames at every step with the newest offsets, computes all
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
from functools import cache, partial
from pathlib import Path

import torch
from jaxtyping import Float
from results import write_json
from scene import make_camera
from timing import Timing, time_together
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from dsar.avatar.avatar import Avatar
from dsar.avatar.charts import Atlas
from dsar.config import PRESETS, ModelConfig
from dsar.data.captures.formats import open_capture
from dsar.evaluation.profiling import count_stage_flops, read_clock, time_stages
from dsar.network import DualStreamNetwork, NetworkOutput
from dsar.network.reference import ReferenceNetwork, ReferenceRollout, doubling_kernels
from dsar.network.session import InferenceSession
from dsar.raster import rasterize
from dsar.types import Motion, RenderOutput

LITERAL = "literal"
WIRINGS = ("shared", "late", "perframe")
HEADLINE = ("demo", 10)


@dataclass(frozen=True)
class Case:
    """A size of the network."""

    preset: str
    window: int
    """Frames n; the bank holds as many."""
    batch: int
    """Rollouts of a step of training."""
    image: tuple[int, int]
    """Width and height of a drawn frame."""

    def config(self, wiring: str) -> ModelConfig:
        """Return the preset's network with this window and wiring."""
        changes = {"wiring": wiring, "window": self.window, "memory": self.window}
        return dataclasses.replace(PRESETS[self.preset].model, **changes)


CASES = (
    Case("demo", 5, 64, (192, 256)),
    Case("demo", 10, 64, (192, 256)),
    Case("small", 10, 16, (192, 256)),
    Case("paper", 10, 1, (940, 1280)),
)
QUICK = (Case("demo", 10, 64, (192, 256)),)


@dataclass(frozen=True)
class Subject:
    """One design at one size, ready to be timed."""

    network: DualStreamNetwork
    """What `rollout` runs."""
    rollout: Callable[[], NetworkOutput]
    """Computes the network's next frame."""
    frame: Callable[[], RenderOutput]
    """Computes the next frame and draws it: input maps, network, posing, one image."""
    training: Callable[[], None]
    """Computes a step's gradients."""


@cache
def find_atlas(preset: str) -> tuple[Atlas, Motion]:
    """Return a preset's atlas of the embedded capture, and a motion."""
    capture, config = open_capture(), PRESETS[preset]
    avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model)
    return avatar.atlas, capture.motions["far"]


def build(case: Case, design: str, device: str) -> Subject:
    """Return a design with random weights."""
    torch.manual_seed(0)
    atlas, motion = find_atlas(case.preset)
    config = case.config("shared" if design == LITERAL else design)
    avatar = Avatar(open_capture().body, atlas, config, motion.fps)
    network = avatar.to(device).network
    signal = avatar.driving_signal(motion)
    torch.nn.init.normal_(network.decoder.head.weight, std=0.01)
    drawn = draw_maps(config, case, avatar.control.size, device)
    if design == LITERAL:
        reference = ReferenceNetwork(network, doubling_kernels(network))
        rollout, training = ReferenceRollout(reference), partial(train_reference, reference, *drawn)
    else:
        rollout = InferenceSession(network, precision=torch.bfloat16 if device == "cuda" else None)
        network, training = rollout.network, partial(train, network, *drawn)
    maps, magnitude = (x[-1, :1] for x in drawn)

    @torch.no_grad()
    def step() -> NetworkOutput:
        return rollout.step(maps, magnitude)

    motion_window, cloth, camera = signal.windows[[70]], signal.cloth_at([70]), make_camera(*case.image)

    @torch.no_grad()
    def frame() -> RenderOutput:
        output = rollout.step(*avatar.standardize(avatar.input_maps(motion_window, avatar.fps, cloth)))
        return rasterize(avatar.gaussians(motion_window, output)[0], camera)

    # The first frame fills the window.
    step()
    return Subject(network, step, frame, training)


def draw_maps(
    config: ModelConfig, case: Case, size: tuple[int, int], device: str
) -> tuple[Float[Tensor, "n b c h w"], Float[Tensor, "n b 1 h w"]]:
    """Return random input maps and magnitudes of a window."""
    shape = (config.window, case.batch)
    maps = torch.randn(*shape, config.map_channels, *size, device=device)
    return maps, torch.rand(*shape, 1, *size, device=device)


def train(network: DualStreamNetwork, maps: Tensor, magnitudes: Tensor) -> None:
    """Back-propagate one step, from a state that was carried on."""
    state = network.initial_state(maps.shape[1])
    state = dataclasses.replace(state, fresh=torch.zeros_like(state.fresh))
    output, _ = network(maps[-1], magnitudes[-1], state)
    _backward(network, output)


def train_reference(reference: ReferenceNetwork, maps: Tensor, magnitudes: Tensor) -> None:
    """Back-propagate one step of the literal design."""
    state = reference.network.initial_state(maps.shape[1])
    frames = (maps.transpose(0, 1), magnitudes.transpose(0, 1))
    output, _ = reference(*frames, state.offsets[:, -1], state.memory)
    _backward(reference, output)


def _backward(module: torch.nn.Module, output: NetworkOutput) -> None:
    module.zero_grad()
    (output.offset.sum() + output.appearance.sum()).backward()


def measure(case: Case, device: str, seconds: float) -> list[dict]:
    """Return a row for each design and pass, all designs timed in turn."""
    subjects = {design: build(case, design, device) for design in (LITERAL, *WIRINGS)}
    rows = []
    for name, batch in (("rollout", 1), ("frame", 1), ("training", case.batch)):
        same = {"preset": case.preset, "window": case.window, "pass": name, "batch": batch}
        same |= {"width": case.image[0], "height": case.image[1]}
        made = [{"design": design, **same} for design in subjects]
        rows += made
        functions = [partial(_finish, getattr(subject, name)) for subject in subjects.values()]
        for function in functions:
            function()
        for row, timing in zip(made, time_together(functions, seconds, 400), strict=True):
            row |= _per_rollout(timing, batch)
        if device == "cpu" and name != "frame":
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
    return {"gflop": count_stage_flops(subject.network, subject.rollout), "parts_ms": _parts(subject)}


def _per_rollout(timing: Timing, batch: int) -> dict:
    values = asdict(timing)
    return {key: value / batch if key.endswith("_ms") else value for key, value in values.items()}


def _parts(subject: Subject, repeats: int = 10) -> dict[str, float]:
    """Return the median milliseconds of a rollout's frame by part."""
    found = defaultdict(list)
    for _ in range(repeats):
        for name, milliseconds in time_stages(subject.network, subject.rollout)[1].items():
            found[name].append(milliseconds)
    return {name: statistics.median(values) for name, values in found.items()}


def find_ratios(rows: list[dict]) -> list[dict]:
    """Return how many times as fast each design is as the literal one."""
    same = ("preset", "window", "pass")
    literal = {tuple(r[key] for key in same): r for r in rows if r["design"] == LITERAL}
    ratios = []
    for row in rows:
        case = tuple(row[key] for key in same)
        if row["design"] != LITERAL:
            ratio = literal[case]["median_ms"] / row["median_ms"]
            ratios.append({"design": row["design"], **dict(zip(same, case, strict=True)), "ratio": ratio})
    return ratios


def describe(row: dict) -> str:
    """Return a row in words."""
    case = f"{row['design']:9} {row['preset']:6} n={row['window']:<3} {row['pass']:9}"
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
    parser.add_argument("--paper", action="store_true", help="the paper's size on a CPU, too: an hour")
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
    cases = CASES if arguments.paper or arguments.device == "cuda" else CASES[:-1]
    for case in QUICK if arguments.quick else cases:
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
