"""What a run will need, said before it starts: memory and hours; and what would help where it does not fit.

The memory is what an update takes on torch's `meta` device (`dsar.training.update_cost`), and what a process
and its libraries take besides. The hours are that update's operations at the rates of this device, which are
measured.
"""

import dataclasses
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

from dsar.config import PRESETS, TrainConfig
from dsar.errors import ConfigError
from dsar.training.device_rates import measure_rates
from dsar.training.launch import launched
from dsar.training.update_cost import UpdateCost, cost_of_update

_log = logging.getLogger(__name__)
_PROCESS = 600 * 2**20
"""What a worker needs before it has a network: interpreter, torch, kernels, capture."""
_CONTEXT = 700 * 2**20
"""What CUDA, cuBLAS, cuDNN and Warp take of a GPU (an estimate)."""
_FRAGMENTS = 1.05
"""What torch's allocator takes for what it is asked for (an estimate)."""
_SAFE = 0.9
"""Share of the free memory up to which activations are kept: it costs less to recompute than to run out."""
_LONGEST_DAYS = 30
_GIB = 2**30

View = tuple[int, int]
"""Height and width of an image, pixels."""


@dataclass(frozen=True)
class Budget:
    """What one worker needs."""

    config: TrainConfig
    """Its settings; whether the network recomputes is decided."""
    memory: int
    """Bytes, all in all."""
    cost: UpdateCost
    """Of an update of the autoregressive stage."""
    network_seconds: float = 0.0
    """What the network takes of an update at least; 0: not measured."""


@dataclass(frozen=True)
class Room:
    """Where a run is to fit: workers that share a device, and what else they keep there."""

    device: torch.device
    processes: int
    """Workers on the device."""
    images: int
    """Bytes of decoded images that a worker keeps in main memory."""
    view: View
    """The largest view that is compared."""

    def needed(self, budget: Budget) -> int:
        """Return the bytes that all its workers take of the device."""
        return (budget.memory + self.images * (self.device.type != "cuda")) * self.processes


_Change = tuple[str, Callable[[TrainConfig, Room], tuple[TrainConfig, Room]]]
"""Flags, and what they do."""


def estimate(config: TrainConfig, view: View, device: torch.device | None = None) -> Budget:
    """Return what settings ask of a worker that compares views of a height and width in pixels.

    A recomputation that is `auto` counts as off.
    """
    cost = cost_of_update(config, view)
    if device is None or device.type != "cuda":
        return Budget(config, _PROCESS + cost.total_memory, cost)
    # A library may copy the operands of a convolution into the layout that its kernel likes.
    workspace = max(o.traffic for o in cost.operations if o.arithmetic == "convolution")
    return Budget(config, _CONTEXT + workspace + int(_FRAGMENTS * cost.total_memory), cost)


def check_budget(config: TrainConfig, room: Room, done: float = 0.0) -> Budget:
    """Return the estimate of a run that fits, with `schedule.recomputation` decided.

    Args:
        config: Its settings.
        room: Where it is to fit.
        done: Share of the schedule that an earlier part of the run has done.

    Raises:
        ConfigError: it does not fit, with what to change.
    """
    free = available_memory(room.device)
    budget = _decided(config, room, free)
    where = f"preset {config.preset}, {room.processes} worker(s) on {room.device}"
    if free is not None and room.needed(budget) > free:
        raise ConfigError(
            f"training ({where}) needs about {room.needed(budget) / _GIB:.1f} GiB, {free / _GIB:.1f} GiB are "
            f"free; most is for {_largest_parts(budget.cost)}. {_advice(config, room, free)}"
        )
    rates = measure_rates(room.device)
    network_seconds = budget.cost.network_flop / rates.convolution
    seconds = network_seconds if room.device.type == "cpu" else rates.seconds(budget.cost.operations)
    # The template's updates do not run the network.
    share = min(1 - done, 1 - config.schedule.template_fraction)
    hours = seconds * share * config.schedule.steps / 3600
    if config.schedule.minutes is None and hours > 24 * _LONGEST_DAYS:
        raise ConfigError(
            f"training ({where}) would take {hours / 24:.0f} days or more: {config.schedule.steps} updates, "
            f"most of at least {seconds:.1f} s; give --minutes or --steps, or take --preset small"
        )
    _log.info(
        "A worker needs about %.1f GiB%s, an update %.2f s or more, the run %.1f hours or more",
        budget.memory / _GIB,
        f" of {free / _GIB:.1f} that are free" if free is not None else "",
        seconds,
        hours,
    )
    return dataclasses.replace(budget, network_seconds=network_seconds)


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


def _decided(config: TrainConfig, room: Room, free: int | None) -> Budget:
    """Return the estimate with a recomputation that is `auto` switched on where it is needed, else off."""
    if config.schedule.recomputation != "auto":
        return estimate(config, room.view, room.device)
    kept = estimate(_with(config, "schedule", recomputation="off"), room.view, room.device)
    if free is None or room.needed(kept) <= _SAFE * free:
        return kept
    again = estimate(_with(config, "schedule", recomputation="on"), room.view, room.device)
    _log.info(
        "With activations kept, training needs %.1f GiB of %.1f that are free: they are computed again on "
        "the way back, which takes %.1f GiB and more time (--schedule.recomputation)",
        room.needed(kept) / _GIB,
        free / _GIB,
        room.needed(again) / _GIB,
    )
    return again


def _largest_parts(cost: UpdateCost) -> str:
    """Return the three largest parts of the memory, in words."""
    parts = sorted(cost.memory.items(), key=lambda item: -item[1])[:3]
    return ", ".join(f"{name} ({size / _GIB:.1f})" for name, size in parts)


def _advice(config: TrainConfig, room: Room, free: int) -> str:
    """Return which flags make a run fit, each by itself or else together, and what it needs with them."""
    if config.schedule.recomputation == "auto":
        config = _with(config, "schedule", recomputation="on")
    found, together, strongest = [], [], (config, room)
    for changes in _changes(config, room):
        for flag, change in changes:
            if (needed := _needed(*change(config, room))) <= free:
                found.append(f"{flag} ({needed / _GIB:.1f} GiB)")
                break
        flag, change = changes[-1]
        together, strongest = [*together, flag], change(*strongest)
        if not found and len(together) > 1 and (needed := _needed(*strongest)) <= free:
            found.append(f"{' '.join(together)} ({needed / _GIB:.1f} GiB)")
            break
    if not found and (needed := _needed(PRESETS["small"], room)) <= free:
        found.append(f"--preset small ({needed / _GIB:.1f} GiB)")
    return f"What fits: {', or '.join(found)}" if found else "No setting makes it fit: take another device"


def _changes(config: TrainConfig, room: Room) -> Iterator[list[_Change]]:
    """Yield, by setting, the changes that make a run smaller, the mildest first."""
    schedule = config.schedule
    if schedule.recomputation == "off":
        yield [_setting("schedule", "recomputation", "on")]
    if room.processes > 1:
        flag = "--workers 1" if launched() is None else "--nproc-per-node 1 of torchrun"
        yield [(flag, lambda config, room: (config, dataclasses.replace(room, processes=1)))]
    for name in ("rollouts_per_worker", "views", "chunk_frames"):
        if changes := [_setting("schedule", name, value) for value in _halves(getattr(schedule, name))]:
            yield changes
    resolutions = (_setting("atlas", "resolution", value) for value in _halves(config.atlas.resolution))
    if changes := [change for change in resolutions if _is_valid(change[1](config, room)[0])]:
        yield changes


def _setting(section: str, name: str, value: object) -> _Change:
    flag = f"--{section}.{name.replace('_', '-')} {value}"
    return flag, lambda config, room: (_with(config, section, **{name: value}), room)


def _is_valid(config: TrainConfig) -> bool:
    try:
        config.validate()
    except ConfigError:
        return False
    return True


def _halves(count: int) -> Iterator[int]:
    while count > 1:
        count //= 2
        yield count


def _needed(config: TrainConfig, room: Room) -> int:
    return room.needed(estimate(config, room.view, room.device))


def _with(config: TrainConfig, section: str, **values: object) -> TrainConfig:
    """Return settings with others in a section."""
    return dataclasses.replace(config, **{section: dataclasses.replace(getattr(config, section), **values)})
