"""The meter counts what lives, what is computed and what is moved, the same on every device."""

import gc

import pytest
import torch
from torch.utils.checkpoint import checkpoint
from torch.utils.flop_counter import FlopCounterMode

from dsar.training.operation_meter import OperationMeter

FLOATS = 4


def test_memory_is_counted_while_it_lives_and_by_part():
    with OperationMeter("cpu") as meter:
        with meter.part("first"):
            a = torch.zeros(1000)
        with meter.part("second"):
            b = a + 1
            view = b[:10]
        del a
        with meter.part("third"):
            c = torch.zeros(100)
    assert meter.peak == {"first": 1000 * FLOATS, "second": 1000 * FLOATS}
    assert +meter.live == {"second": 1000 * FLOATS, "third": 100 * FLOATS}
    del b, c
    # A view keeps all that it looks at.
    assert +meter.live == {"second": 1000 * FLOATS}
    del view
    gc.collect()
    assert not +meter.live


def test_what_was_made_before_counts_once_it_is_followed():
    before = torch.zeros(50)
    meter = OperationMeter("cpu")
    meter.follow("weights", [before, before[:5]])
    with meter:
        before.add_(1)
    assert meter.peak == {"weights": 50 * FLOATS}


def network():
    torch.manual_seed(0)
    layers = (
        torch.nn.Conv2d(3, 8, 3, padding=1),
        torch.nn.ReLU(),
        torch.nn.Conv2d(8, 8, 3),
        torch.nn.Flatten(2),
    )
    return torch.nn.Sequential(*layers, torch.nn.Linear(36, 5))


@pytest.mark.parametrize("recomputed", [False, True])
def test_a_step_on_meta_is_metered_as_on_the_cpu(recomputed):
    found = []
    for device in ("cpu", "meta"):
        layers, x = network().to(device), torch.rand(2, 3, 8, 8).to(device)
        meter, counter = OperationMeter(device), FlopCounterMode(display=False)
        with counter, meter:
            y = checkpoint(layers, x, use_reentrant=False) if recomputed else layers(x)
            y.sum().backward()
        assert sum(o.flop for o in meter.operations) == counter.get_total_flops()
        found.append((sum(meter.peak.values()), [(o.arithmetic, o.flop) for o in meter.operations if o.flop]))
    assert found[0] == found[1]
    assert found[0][1]


def test_traffic_is_what_is_read_and_written():
    x, y = torch.zeros(100), torch.zeros(100, dtype=torch.float64)
    with OperationMeter("cpu") as meter:
        x.view(10, 10).t()  # no memory is touched
        y.add_(x)
        x + x
    assert [o.traffic for o in meter.operations] == [100 * (8 + 4), 2 * 100 * 4]
    assert {o.arithmetic for o in meter.operations} == {"elementwise"}
