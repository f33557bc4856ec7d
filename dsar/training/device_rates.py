"""How fast a device is, measured in about a second: all that the time of an update is estimated from."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor, nn

from dsar.training.operation_meter import Operation

_CHANNELS, _SIDE = 64, 64
_IMAGES = (4, 256)
"""Fewest and most images of a measured convolution: a CPU is busy with four of them, a GPU is not."""
_ENOUGH_S, _MOST_RUNS = 0.06, 200
_SHORT_S = 2e-3
"""A run that takes less is made larger, if it may."""
_FLOAT_BYTES = 4

_Make = Callable[[int, torch.device], tuple[int, Callable[[], Tensor]]]
"""From a size and a device to an amount of work, and what does it."""


@dataclass(frozen=True)
class DeviceRates:
    """What a device does in a second, on one thread of its host."""

    convolution: float
    """Floating-point operations of convolutions like the network's, forward and backward."""
    product: float
    """Floating-point operations of float32 matrix products."""
    bandwidth: float
    """Bytes read and written."""
    launches: float
    """Operations begun: small ones take no less."""

    def seconds(self, operations: Iterable[Operation]) -> float:
        """Return what operations take one after another, each as fast as its scarcest resource lets it."""
        rate = {"convolution": self.convolution, "product": self.product, "elementwise": float("inf")}
        return sum(
            max(o.flop / rate[o.arithmetic], o.traffic / self.bandwidth, 1 / self.launches)
            for o in operations
        )


@lru_cache
def measure_rates(device: torch.device) -> DeviceRates:
    """Measure a device, on one thread and once in a process."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return DeviceRates(
            *(_best_rate(make, device) for make in (_convolution, _product, _copy, _small_operations))
        )
    finally:
        torch.set_num_threads(threads)
        if device.type == "cuda":
            # Other processes want what was measured with.
            torch.cuda.empty_cache()


def _best_rate(make: _Make, device: torch.device) -> float:
    """Return the highest rate of a kind of work, over sizes that a device may need to be busy."""
    best, images = 0.0, _IMAGES[0]
    while images <= _IMAGES[1]:
        amount, run = make(images, device)
        seconds = _time(run)
        best, images = max(best, amount / seconds), 4 * images
        if seconds > _SHORT_S:
            break
    return best


def _time(run: Callable[[], Tensor]) -> float:
    """Return the seconds of one of several runs."""
    run().flatten()[0].item()
    start, runs, taken = time.perf_counter(), 0, 0.0
    while taken < _ENOUGH_S and runs < _MOST_RUNS:
        # Read, for a GPU works behind the host's back; not each time, for that takes time, too.
        results = [run() for _ in range(max(runs, 1))]
        runs += len(results)
        results[-1].flatten()[0].item()
        taken = time.perf_counter() - start
    return taken / runs


def _convolution(images: int, device: torch.device) -> tuple[int, Callable[[], Tensor]]:
    layer = nn.Conv2d(_CHANNELS, _CHANNELS, 3, padding=1).to(device)
    x = torch.rand(images, _CHANNELS, _SIDE, _SIDE, device=device, requires_grad=True)
    x = x.to(memory_format=torch.channels_last)

    def run() -> Tensor:
        return torch.autograd.grad(layer(x).sum(), [x, layer.weight])[1]

    return 3 * 2 * 9 * _CHANNELS * x.numel(), run


def _product(images: int, device: torch.device) -> tuple[int, Callable[[], Tensor]]:
    x = torch.rand(images * _SIDE, 16 * _SIDE, device=device)
    y = torch.rand(16 * _SIDE, 16 * _SIDE, device=device)
    return 2 * x.numel() * y.shape[1], lambda: x @ y


def _copy(images: int, device: torch.device) -> tuple[int, Callable[[], Tensor]]:
    x = torch.rand(images * _SIDE**4 // 16, device=device)
    y = torch.empty_like(x)
    return 2 * _FLOAT_BYTES * x.numel(), lambda: y.copy_(x)


def _small_operations(images: int, device: torch.device) -> tuple[int, Callable[[], Tensor]]:
    x = torch.zeros(1, device=device)

    def run() -> Tensor:
        for _ in range(images):
            x.add_(1.0)
        return x

    return images, run
