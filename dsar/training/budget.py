"""What a run will need, estimated before it starts: memory of a worker and time of an update.

The network is run on torch's `meta` device, which computes sizes and no values. Posing, rasterising and
image losses are not counted, so both are lower bounds; for the `paper` preset the network is most of it.
"""

import dataclasses
import logging
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from dsar.config import TrainConfig
from dsar.errors import ConfigError
from dsar.network import NetworkState, build_network

_log = logging.getLogger(__name__)
_BYTES_PER_PARAMETER = 16
"""Weight, gradient and two moments."""
_BASE = 600 * 2**20
"""What a worker needs before it has a network: interpreter, torch, kernels, capture."""
_PAST_OUTPUTS = 2
_LONGEST_DAYS = 30
_REPEATS = 10


@dataclass(frozen=True)
class Budget:
    """What one worker needs for one update of the autoregressive stage."""

    memory: int
    """Bytes, all in all."""
    flop: int
    """Floating-point operations of the network, forward and backward."""
    parameters: int
    """Of the network."""
    seconds: float = 0.0
    """What these operations take on this machine, in one thread; 0: not measured."""


def map_size(config: TrainConfig) -> tuple[int, int]:
    """Return height and width of the network's maps; with a garment chart, if one may come."""
    atlas = config.atlas
    rows = atlas.resolution + atlas.garment_rows * (atlas.garment == "auto")
    return rows // config.model.upsample, atlas.resolution // config.model.upsample


def estimate(config: TrainConfig) -> Budget:
    """Return what the settings ask for."""
    size, schedule = map_size(config), config.schedule
    with torch.device("meta"):
        network = build_network(config.model, torch.ones(size, dtype=torch.bool))
        state = network.initial_state(schedule.rollouts_per_worker)
        maps = torch.empty(schedule.rollouts_per_worker, config.model.map_channels, *size)
        magnitude = torch.empty(schedule.rollouts_per_worker, 1, *size)
    # The network looks at it, so it needs values.
    state = dataclasses.replace(state, fresh=torch.zeros(schedule.rollouts_per_worker, dtype=torch.bool))
    kept: list[Tensor] = []

    def keep(tensor: Tensor) -> Tensor:
        kept.append(tensor)
        return tensor

    hooks = torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor)
    with FlopCounterMode(display=False) as counter, hooks:
        loss, output = torch.zeros((), device="meta"), None
        for _ in range(schedule.chunk_frames):
            output, state = network(maps, magnitude, state)
            loss = loss + output.offset.sum() + output.appearance.sum()
        loss.backward()
    assert output is not None
    weights = {p.untyped_storage()._cdata for p in network.parameters()}
    saved = {tensor.untyped_storage()._cdata: tensor.untyped_storage().nbytes() for tensor in kept}
    activations = sum(size for storage, size in saved.items() if storage not in weights)
    parameters = sum(p.numel() for p in network.parameters())
    # A step makes the next state while the last is still there, and temporal losses look back two frames.
    outputs = (output.offset, output.appearance, *output.features)
    past = _PAST_OUTPUTS * sum(tensor.numel() * tensor.element_size() for tensor in outputs)
    memory = _BASE + _BYTES_PER_PARAMETER * parameters + activations + 2 * _count_bytes(state) + past
    return Budget(memory, counter.get_total_flops(), parameters)


def check_budget(
    config: TrainConfig,
    processes: int,
    done: float = 0.0,
    images: int = 0,
    device: torch.device | None = None,
) -> Budget:
    """Return the estimate of a run that fits this machine.

    Args:
        config: Its settings.
        processes: Workers on this machine.
        done: Share of the schedule that an earlier part of the run has done.
        images: Bytes of decoded images that a worker keeps in main memory.
        device: Where it computes; None: the CPU.

    Raises:
        ConfigError: it does not fit, with what to change.
    """
    device = device or torch.device("cpu")
    budget, memory = estimate(config), available_memory(device)
    needed = (budget.memory + images * (device.type != "cuda")) * processes
    where = f"preset {config.preset}, {processes} worker(s) on {device}"
    if memory is not None and needed > memory:
        raise ConfigError(
            f"training ({where}) needs about {needed / 2**30:.1f} GiB, {memory / 2**30:.1f} GiB are free; "
            f"most are activations of {config.schedule.chunk_frames} frame(s) of "
            f"{config.schedule.rollouts_per_worker} rollout(s): lower --schedule.chunk-frames, "
            "--schedule.rollouts-per-worker or --workers, or take --model.wiring perframe or --preset small"
        )
    seconds = budget.flop / measure_flops(device)
    # The template's updates do not run the network.
    share = min(1 - done, 1 - config.schedule.template_fraction)
    days = seconds * share * config.schedule.steps / 86400
    if config.schedule.minutes is None and days > _LONGEST_DAYS:
        raise ConfigError(
            f"training ({where}) would take {days:.0f} days or more: {config.schedule.steps} updates, most "
            f"of at least {seconds:.1f} s; give --minutes or --steps, or take --preset small"
        )
    _log.info("An update needs %.1f s or more, a worker %.1f GiB", seconds, budget.memory / 2**30)
    return dataclasses.replace(budget, seconds=seconds)


def available_memory(device: torch.device | None = None) -> int | None:
    """Return the bytes that processes may still take: of a GPU, or of main memory where Linux tells."""
    if device is not None and device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    limits = []
    meminfo, cgroup = Path("/proc/meminfo"), Path("/sys/fs/cgroup")
    if meminfo.exists():
        entries = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
        limits.append(1024 * int(entries["MemAvailable"].split()[0]))
    limit, used = cgroup / "memory.max", cgroup / "memory.current"
    if limit.exists() and used.exists() and limit.read_text().strip().isdigit():
        counts = dict(line.split() for line in (cgroup / "memory.stat").read_text().splitlines())
        # Files that nobody reads any more count as used, and make room when it is wanted.
        taken = int(used.read_text()) - int(counts.get("inactive_file", 0))
        limits.append(int(limit.read_text()) - taken)
    return min(limits, default=None)


def measure_flops(device: torch.device | None = None) -> float:
    """Return the floating-point operations a second of a convolution like the network's, in one thread."""
    layer, x = nn.Conv2d(64, 64, 3, padding=1).to(device), torch.rand(4, 64, 64, 64, device=device)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            y = layer(x)
            y[0, 0, 0, 0].item()
            start = time.perf_counter()
            for _ in range(_REPEATS):
                y = layer(x)
            # Read, for a GPU works behind the host's back.
            y[0, 0, 0, 0].item()
            seconds = time.perf_counter() - start
    finally:
        torch.set_num_threads(threads)
    return _REPEATS * 2 * 9 * 64**2 * x.numel() / 64 / seconds


def _count_bytes(state: NetworkState) -> int:
    sizes: list[int] = []

    def add(tensor: Tensor) -> Tensor:
        sizes.append(tensor.numel() * tensor.element_size())
        return tensor

    state.map(add)
    return sum(sizes)
