"""The paper's size on paper: memory by part, what fits which card, and hours, as Markdown tables.

    python benchmarks/paper_size.py

Nothing here is measured: memory is what training's own estimate says (`dsar.training.budget`), hours are that
estimate's operations at a share of the rates that NVIDIA publishes.
"""

import dataclasses
import sys
from collections.abc import Iterator

import torch

from dsar.config import PRESETS, TrainConfig
from dsar.training.budget import Budget, estimate
from dsar.training.device_rates import DeviceRates

VIEW = (1280, 940)
CUDA = torch.device("cuda")
GIB = 2**30
CARDS = {
    "RTX 4090": (82.6e12, 82.6e12, 1.01e12),
    "A100": (156e12, 19.5e12, 2.04e12),
    "H100": (495e12, 67e12, 3.35e12),
}
"""TF32 without sparsity, which convolutions take, float32, and bytes a second: NVIDIA's data sheets."""
ARITHMETIC_SHARE, MEMORY_SHARE = 0.5, 0.8
"""What is assumed to be reached of them."""
LAUNCHES = 1e5
"""Operations that a host begins in a second; assumed."""
CHANGES = {
    "as it is": {},
    "2 rollouts": {"rollouts_per_worker": 2},
    "4 views a frame": {"views": 4},
    "chunks of 8 frames": {"chunk_frames": 8},
    "chunks of 16 frames": {"chunk_frames": 16},
    "chunks of 2 frames": {"chunk_frames": 2},
    "chunks of 1 frame": {"chunk_frames": 1},
}


def changed(**values: object) -> TrainConfig:
    """Return the paper's preset with another schedule."""
    config = PRESETS["paper"]
    return dataclasses.replace(config, schedule=dataclasses.replace(config.schedule, **values))


def both(**values: object) -> list[Budget]:
    """Return what is needed with activations kept, and recomputed."""
    return [estimate(changed(recomputation=r, **values), VIEW, CUDA) for r in ("off", "on")]


def hours(budget: Budget, card: str) -> tuple[float, float]:
    """Return seconds of an update, and hours of all that run the network."""
    convolution, product, bandwidth = CARDS[card]
    rates = DeviceRates(
        ARITHMETIC_SHARE * convolution, ARITHMETIC_SHARE * product, MEMORY_SHARE * bandwidth, LAUNCHES
    )
    seconds, schedule = rates.seconds(budget.cost.operations), budget.config.schedule
    return seconds, seconds * schedule.steps * (1 - schedule.template_fraction) / 3600


def lines() -> Iterator[str]:
    """Yield the tables, line by line."""
    kept, again = both()
    yield from ("| GiB | kept | recomputed |", "|---|---|---|")
    parts = [name for name in kept.cost.memory if name]
    for name in sorted(parts, key=lambda name: -kept.cost.memory[name]):
        yield f"| {name} | {kept.cost.memory[name] / GIB:.2f} | {again.cost.memory[name] / GIB:.2f} |"
    rests = [(b.memory - b.cost.total_memory) / GIB for b in (kept, again)]
    yield f"| context, workspace, fragments | {rests[0]:.2f} | {rests[1]:.2f} |"
    yield f"| **all** | **{kept.memory / GIB:.1f}** | **{again.memory / GIB:.1f}** |"
    yield from ("", "| GiB | kept | recomputed |", "|---|---|---|")
    for name, values in CHANGES.items():
        yield f"| {name} | " + " | ".join(f"{b.memory / GIB:.1f}" for b in both(**values)) + " |"
    yield from ("", "| | kept | recomputed |", "|---|---|---|")
    for card in CARDS:
        cells = [f"{s * 1e3:.0f} ms, {h:.0f} h" for s, h in (hours(b, card) for b in (kept, again))]
        yield f"| {card} | {cells[0]} | {cells[1]} |"


if __name__ == "__main__":
    sys.stdout.writelines(f"{line}\n" for line in lines())
