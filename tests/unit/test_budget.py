"""The estimate before training: true where it can be checked, and a refusal where a run cannot work."""

import dataclasses

import pytest
import torch

from dsar.config import PRESETS, ModelConfig, ScheduleConfig, TrainConfig
from dsar.errors import ConfigError
from dsar.network import build_network
from dsar.training import budget

SMALL = TrainConfig(
    model=ModelConfig(channels=(8, 16), window=3, memory=2, heads=2),
    schedule=ScheduleConfig(rollouts_per_worker=3, chunk_frames=2),
)


@pytest.mark.parametrize("wiring", ["shared", "late", "perframe"])
def test_activations_are_those_that_a_real_step_keeps(wiring):
    config = dataclasses.replace(SMALL, model=dataclasses.replace(SMALL.model, wiring=wiring))
    size = budget.map_size(config)
    network = build_network(config.model, torch.ones(size, dtype=torch.bool))
    state = network.initial_state(3)
    state = dataclasses.replace(state, fresh=torch.zeros(3, dtype=torch.bool))
    maps, magnitude = torch.randn(3, config.model.map_channels, *size), torch.rand(3, 1, *size)
    saved = {}

    def keep(tensor):
        saved[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    outputs = []
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        for _ in range(2):
            output, state = network(maps, magnitude, state)
            outputs.append(output)
    weights = {p.untyped_storage().data_ptr() for p in network.parameters()}
    real = sum(size for place, size in saved.items() if place not in weights)
    found = budget.estimate(config)
    assert found.parameters == sum(p.numel() for p in network.parameters())
    outputs = (output.offset, output.appearance, *output.features)
    past = budget._PAST_OUTPUTS * sum(t.numel() * t.element_size() for t in outputs)
    fixed = budget._BASE + budget._BYTES_PER_PARAMETER * found.parameters + past
    fixed += 2 * budget._count_bytes(state)
    assert abs((found.memory - fixed) / real - 1) < 0.1


def test_the_papers_preset_is_refused_where_it_does_not_fit(monkeypatch):
    monkeypatch.setattr(budget, "available_memory", lambda *_: 24 * 2**30)
    with pytest.raises(
        ConfigError, match=r"about \d+\.\d GiB, 24\.0 GiB are free; .*--schedule.chunk-frames"
    ):
        budget.check_budget(PRESETS["paper"], 2)
    monkeypatch.setattr(budget, "available_memory", lambda *_: 2**40)
    monkeypatch.setattr(budget, "measure_flops", lambda *_: 1e11)
    with pytest.raises(ConfigError, match=r"would take \d+ days or more.*--minutes"):
        budget.check_budget(PRESETS["paper"], 2)
    # What is left of a run that is all but done takes no time.
    budget.check_budget(PRESETS["paper"], 2, done=0.999)


def test_the_papers_network_has_the_papers_size():
    """Its n encodings make 1 TFLOP a frame; three times that with gradients (reference arithmetic)."""
    config = PRESETS["paper"]
    one = dataclasses.replace(config, schedule=dataclasses.replace(config.schedule, chunk_frames=1))
    assert 3.0e12 < budget.estimate(one).flop < 5.0e12
    assert 10e6 < budget.estimate(one).parameters < 15e6


def test_the_demo_fits_a_laptop():
    assert budget.estimate(PRESETS["demo"]).memory < 2 * 2**30
    assert budget.measure_flops() > 1e9
    assert budget.available_memory() is None or budget.available_memory() > 2**20
