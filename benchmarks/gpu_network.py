"""The GPU benchmark's network: literal and default design, by precision and by how it is started."""

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial

import torch
from gpu_memory import forget_peak, read_peak
from network import LITERAL, Case, draw_maps, train, train_reference
from timing import time_runs
from torch import Tensor

from dsar.config import PRESETS, TrainConfig
from dsar.devices import choose_device
from dsar.evaluation.profiling import read_clock
from dsar.network import DualStreamNetwork, build_network
from dsar.network.reference import ReferenceNetwork, doubling_kernels
from dsar.network.session import InferenceSession
from dsar.training.update_cost import map_size

MOST_RUNS = 300
WARM_UP = 8
"""Steps before times count, after which variants are compared; a session records its graph in the fourth."""
PRECISIONS = ("float32", "tf32", "bf16")
STARTS = ("eager", "graph", "compiled")
"""How a step's kernels are started: one by one, as a recorded graph, or as torch.compile has them."""


@dataclass(frozen=True)
class Variant:
    """One way to compute the same network."""

    design: str
    """`literal`, or a wiring of ours."""
    precision: str
    """Of convolutions and matrix products; the literal design has autocast, ours 16-bit weights."""
    start: str
    """One of STARTS."""


OURS = "shared"
VARIANTS = (
    *(Variant(LITERAL, precision, "eager") for precision in PRECISIONS),
    *(Variant(LITERAL, "tf32", start) for start in ("graph", "compiled")),
    *(Variant(OURS, precision, "eager") for precision in PRECISIONS),
    *(Variant(OURS, precision, "graph") for precision in PRECISIONS),
    Variant(OURS, "tf32", "compiled"),
)
TRAINED = tuple(Variant(design, precision, "eager") for design in (LITERAL, OURS) for precision in PRECISIONS)
CASES = (Case("demo", 10, 64, (192, 256)), Case("paper", 10, 1, (940, 1280)))
QUICK_MODEL = {"channels": (4, 8), "heads": 2, "window": 3, "memory": 2, "upsample": 4}
"""Makes any preset's network tiny."""
QUICK_VARIANTS = (
    Variant(LITERAL, "float32", "eager"),
    Variant(LITERAL, "bf16", "eager"),
    Variant(LITERAL, "tf32", "graph"),
    Variant(OURS, "float32", "eager"),
    Variant(OURS, "bf16", "graph"),
)


def settings(preset: str, quick: bool) -> TrainConfig:
    """Return a preset, or the tiny form of it."""
    config = PRESETS[preset]
    if not quick:
        return config
    atlas = dataclasses.replace(config.atlas, resolution=32, garment_rows=16)
    return dataclasses.replace(config, atlas=atlas, model=dataclasses.replace(config.model, **QUICK_MODEL))


def measure_network(quick: bool, device: str) -> Iterator[dict]:
    """Yield times of a rollout's step, then of a training step, by preset and variant."""
    where, seconds = choose_device(device), 0.02 if quick else 2.0
    for case in CASES:
        config = settings(case.preset, quick)
        if not quick:
            config = dataclasses.replace(config, model=case.config(OURS))
        case = dataclasses.replace(case, batch=2 if quick else case.batch)
        passes = {"rollout": VARIANTS, "training": TRAINED}
        if quick:
            passes = {"rollout": QUICK_VARIANTS, "training": TRAINED[:1]}
        exact: dict[str, Tensor] = {}
        for name, variants in passes.items():
            for variant in variants:
                row = {"preset": case.preset, "pass": name, **asdict(variant)}
                row |= {"batch": 1 if name == "rollout" else case.batch, "skipped": None}
                if variant.start == "graph" and where.type == "cpu":
                    yield row | {"skipped": "a CPU records no graphs"}
                    continue
                yield row | measure_variant(config, case, variant, name, where, seconds, exact)


def measure_variant(
    config: TrainConfig,
    case: Case,
    variant: Variant,
    name: str,
    device: torch.device,
    seconds: float,
    exact: dict[str, Tensor],
) -> dict:
    """Return what one variant takes, and how far its offsets are from `exact`, its design's in float32."""
    forget_peak()
    network, maps, magnitudes = make_inputs(config, case, device)
    found: dict = {}
    lowered = torch.autocast(device.type, torch.bfloat16, enabled=variant.precision == "bf16")
    with tf32(variant.precision != "float32"), lowered:
        if name == "rollout":
            step = make_step(network, maps[:, :1], magnitudes[:, :1], variant)
            for _ in range(WARM_UP):
                offset = step()
            offset = offset.detach().float().cpu().clone()
            reference = exact.setdefault(variant.design, offset)
            found["largest_difference_mm"] = 1e3 * float((offset - reference).abs().max())
        else:
            step = make_training(network, maps, magnitudes, variant)
            step()
        timing = time_runs(partial(_finish, step), seconds, MOST_RUNS)
    return found | asdict(timing) | {"peak_bytes": read_peak()}


def make_inputs(
    config: TrainConfig, case: Case, device: torch.device
) -> tuple[DualStreamNetwork, Tensor, Tensor]:
    """Return a network with random weights, and random maps and magnitudes of a window for a batch.

    Always the same ones, drawn in main memory.
    """
    torch.manual_seed(0)
    model, size = config.model, map_size(config)
    network = build_network(model, torch.ones(size, dtype=torch.bool))
    torch.nn.init.normal_(network.decoder.head.weight, std=0.01)
    maps, magnitudes = draw_maps(model, case, size, "cpu")
    return network.to(device), maps.to(device), magnitudes.to(device)


@contextmanager
def tf32(allowed: bool) -> Iterator[None]:
    """Allow or forbid TF32 in convolutions and matrix products of float32."""
    before = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = allowed
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = before


def make_step(
    network: DualStreamNetwork, maps: Tensor, magnitudes: Tensor, variant: Variant
) -> Callable[[], Tensor]:
    """Return what computes a rollout's next frame, and returns its offsets."""
    if variant.design == LITERAL:
        return _make_literal_step(network, maps, magnitudes, variant.start)
    session = InferenceSession(network, precision=torch.bfloat16 if variant.precision == "bf16" else None)
    advance = session.step
    if variant.start != "graph":
        # Without this `step` would record a graph.
        advance = torch.inference_mode()(session._compute_step)
    newest = maps[-1], magnitudes[-1]
    advance(*newest)  # the first frame fills the rings, which is another program
    if variant.start == "compiled":
        advance = torch.compile(advance)
    # Weights are 16-bit numbers already, and autocast would make float32 of what is to stay so.
    return torch.autocast(maps.device.type, enabled=False)(lambda: advance(*newest).offset)


def _make_literal_step(
    network: DualStreamNetwork, maps: Tensor, magnitudes: Tensor, start: str
) -> Callable[[], Tensor]:
    """Return a step of the literal design from a window and a memory that stay as they are."""
    reference = ReferenceNetwork(network, doubling_kernels(network))
    window = maps.transpose(0, 1).contiguous(), magnitudes.transpose(0, 1).contiguous()
    previous = torch.zeros_like(maps[-1][:, :3])
    with torch.no_grad():
        _, memory = reference(*window, previous, None)
    compute = torch.compile(reference) if start == "compiled" else reference

    @torch.no_grad()
    def step() -> Tensor:
        return compute(*window, previous, memory)[0].offset

    return _record(step) if start == "graph" else step


def _record(step: Callable[[], Tensor]) -> Callable[[], Tensor]:
    """Return a step that replays a recorded graph of another."""
    # On a stream of its own, as recording wants it: what the first steps set up must not be recorded.
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            step()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        offset = step()

    def replay() -> Tensor:
        graph.replay()
        return offset

    return replay


def make_training(
    network: DualStreamNetwork, maps: Tensor, magnitudes: Tensor, variant: Variant
) -> Callable[[], None]:
    """Return what computes the gradients of one step of a batch."""
    if variant.design == LITERAL:
        reference = ReferenceNetwork(network, doubling_kernels(network))
        return partial(train_reference, reference, maps, magnitudes)
    return partial(train, network, maps, magnitudes)


def _finish(step: Callable[[], object]) -> None:
    """Run, and wait for the GPU."""
    step()
    read_clock()
