"""The estimate before training: true where it can be checked, and a refusal where a run cannot work."""

import dataclasses
import functools
import re

import pytest
import torch

from dsar.cli import main
from dsar.config import PRESETS, AtlasConfig, ModelConfig, ScheduleConfig, TrainConfig
from dsar.errors import ConfigError
from dsar.network import build_network
from dsar.training import budget, update_cost
from dsar.training.budget import Room
from dsar.training.checkpoint import Run
from dsar.training.device_rates import DeviceRates, measure_rates
from dsar.training.operation_meter import Operation, OperationMeter
from dsar.training.resuming import check_same_settings
from dsar.training.update_cost import BACKWARD, NETWORK, cost_of_update, estimate_pairs, map_size

GIB = 2**30
PAPER, CARD = PRESETS["paper"], torch.device("cuda")
VIEW = (640, 470)
"""The person in an image of 1280 x 940."""
ROOM = Room(CARD, 1, 2**28, VIEW)
SMALL = TrainConfig(
    atlas=AtlasConfig(resolution=64, garment="off"),
    model=ModelConfig(channels=(8, 16), window=3, memory=2, heads=2, prior="none"),
    schedule=ScheduleConfig(rollouts_per_worker=3, chunk_frames=2),
)
FAST = DeviceRates(convolution=2e14, product=5e13, bandwidth=1e12, launches=2e5)


def with_schedule(config, **values):
    return dataclasses.replace(config, schedule=dataclasses.replace(config.schedule, **values))


COSTS = functools.cache(cost_of_update)


@pytest.fixture
def card(monkeypatch):
    """Return what makes a card with so many GiB free, of rates that are known."""
    monkeypatch.setattr(budget, "cost_of_update", COSTS)

    def make(gib):
        monkeypatch.setattr(budget, "available_memory", lambda *_: int(gib * GIB))
        monkeypatch.setattr(budget, "measure_rates", lambda *_: FAST)

    return make


def chunk(network, config, frames):
    """Return the summed outputs of some frames, and what was saved for the way back, bytes."""
    maps, magnitude = torch.randn(3, config.model.map_channels, *network.occupied.shape[2:]), torch.rand(1)
    magnitude, saved = magnitude.expand(3, 1, *maps.shape[2:]).contiguous(), {}
    state = dataclasses.replace(network.initial_state(3), fresh=torch.zeros(3, dtype=torch.bool))

    def keep(tensor):
        saved[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    loss = torch.zeros(())
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        outputs = []
        for _ in range(frames):
            output, state = network(maps, magnitude, state)
            outputs.append(output)
            loss = loss + output.offset.square().sum() + output.appearance.square().sum()
    weights = {p.untyped_storage().data_ptr() for p in network.parameters()}
    return loss, sum(size for place, size in saved.items() if place not in weights)


def test_what_many_rollouts_cost_follows_from_fewer(monkeypatch):
    config = with_schedule(SMALL, rollouts_per_worker=48)
    whole = cost_of_update(config, (32, 32))
    monkeypatch.setattr(update_cost, "MOST_IMITATED", 16)
    reckoned = cost_of_update(config, (32, 32))
    assert reckoned.total_memory == pytest.approx(whole.total_memory, rel=0.02)
    assert reckoned.network_flop == pytest.approx(whole.network_flop, rel=0.02)
    assert reckoned.parameters == whole.parameters


@pytest.mark.parametrize("wiring", ["shared", "late", "perframe"])
def test_activations_are_those_that_a_real_step_keeps(wiring):
    config = dataclasses.replace(SMALL, model=dataclasses.replace(SMALL.model, wiring=wiring))
    network = build_network(config.model, torch.ones(map_size(config), dtype=torch.bool))
    _, saved = chunk(network, config, 2)
    cost = cost_of_update(config, (32, 32))
    assert cost.parameters == sum(p.numel() for p in network.parameters())
    # Besides what is saved, the states of two frames live.
    assert saved == pytest.approx(cost.memory[NETWORK], rel=0.25)


@pytest.mark.parametrize("recomputes", [False, True])
def test_a_real_chunk_and_its_way_back_take_the_memory_that_meta_says(recomputes):
    config = dataclasses.replace(SMALL, model=dataclasses.replace(SMALL.model, wiring="shared"))
    peaks = []
    for device in ("cpu", "meta"):
        with torch.device(device):
            network = build_network(config.model, torch.ones(map_size(config), dtype=torch.bool))
            network.recomputes = recomputes
            maps, magnitude = torch.zeros(3, config.model.map_channels, 8, 8), torch.zeros(3, 1, 8, 8)
            state = network.initial_state(3)
        state = dataclasses.replace(state, fresh=torch.zeros(3, dtype=torch.bool))
        meter, loss = OperationMeter(device), torch.zeros((), device=device)
        with meter:
            for _ in range(4):
                output, state = network(maps, magnitude, state)
                loss = loss + output.offset.sum() + output.appearance.sum()
            loss.backward()
        peaks.append(sum(meter.peak.values()))
    assert peaks[0] == pytest.approx(peaks[1], rel=0.02)


def test_the_papers_preset_fits_a_card_of_24_gb(card):
    card(23.5)
    found = budget.check_budget(PAPER, ROOM)
    assert found.config.schedule.recomputation == "on"
    assert found.memory < 14 * GIB
    # And nothing else was changed.
    assert with_schedule(found.config, recomputation="auto") == PAPER


def test_activations_are_kept_where_there_is_room(card):
    card(39)
    found = budget.check_budget(PAPER, ROOM)
    assert found.config.schedule.recomputation == "off"
    assert 20 * GIB < found.memory < 0.9 * 39 * GIB


def test_a_resumed_run_may_recompute_or_not_and_change_nothing_else(tmp_path):
    check_same_settings(with_schedule(PAPER, recomputation="on"), PAPER, Run(tmp_path))
    with pytest.raises(ConfigError, match="other values of schedule"):
        check_same_settings(with_schedule(PAPER, recomputation="on", views=2), PAPER, Run(tmp_path))


def test_recomputing_takes_a_third_more_of_the_network():
    on, off = (COSTS(with_schedule(PAPER, recomputation=r), VIEW) for r in ("on", "off"))
    flop = {k: sum(o.flop for o in cost.operations) for k, cost in (("on", on), ("off", off))}
    again = sum(o.flop for o in off.operations if o.part == NETWORK)
    assert flop["on"] - flop["off"] == pytest.approx(again, rel=0.01)
    assert on.memory[NETWORK] < 0.2 * off.memory[NETWORK]
    assert on.memory[BACKWARD] > off.memory[BACKWARD]


@pytest.mark.parametrize(
    ("gib", "config", "room"),
    [
        (9.5, PAPER, ROOM),
        (15, with_schedule(PAPER, recomputation="off"), dataclasses.replace(ROOM, processes=2)),
        (2.5, SMALL, dataclasses.replace(ROOM, device=torch.device("cpu"), processes=4)),
    ],
)
def test_what_a_refusal_advises_fits(card, gib, config, room):
    card(gib)
    with pytest.raises(
        ConfigError, match=rf"about \d+\.\d GiB, {gib:.1f} GiB are free; most is for "
    ) as error:
        budget.check_budget(config, room)
    advice = re.findall(r"(--.+?) \((\d+\.\d) GiB\)", str(error.value).split("What fits: ")[1])
    assert advice
    for flags, needed in advice:
        fitting, fitting_room = config, room
        for name, value in re.findall(r"--(\S+) (\S+)", flags):
            if name == "workers":
                fitting_room = dataclasses.replace(fitting_room, processes=int(value))
            elif name == "preset":
                fitting = PRESETS[value]
            else:
                section, field = name.replace("-", "_").split(".")
                value = int(value) if value.isdigit() else value
                changed = dataclasses.replace(getattr(fitting, section), **{field: value})
                fitting = dataclasses.replace(fitting, **{section: changed})
        found = budget.check_budget(fitting, fitting_room)
        assert fitting_room.needed(found) <= gib * GIB
        assert float(needed) <= gib


def test_a_refusal_names_no_setting_where_none_helps(card):
    card(0.5)
    with pytest.raises(ConfigError, match="No setting makes it fit: take another device"):
        budget.check_budget(SMALL, ROOM)


def test_flags_of_the_advice_are_flags_of_the_command(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    text = capsys.readouterr().out
    for changes in budget._changes(
        with_schedule(PAPER, recomputation="off", views=2, rollouts_per_worker=2),
        dataclasses.replace(ROOM, processes=2),
    ):
        assert changes[0][0].split()[0] in text


def test_a_run_that_would_take_months_is_refused(card, monkeypatch):
    room = dataclasses.replace(ROOM, device=torch.device("cpu"))
    card(1024)
    monkeypatch.setattr(budget, "measure_rates", lambda *_: dataclasses.replace(FAST, convolution=1e11))
    with pytest.raises(ConfigError, match=r"would take \d+ days or more.*--minutes"):
        budget.check_budget(PAPER, room)
    # What is left of a run that is all but done takes no time.
    budget.check_budget(PAPER, room, done=0.999)


def test_memory_and_hours_are_said(card, caplog):
    card(80)
    with caplog.at_level("INFO"):
        budget.check_budget(PAPER, ROOM)
    assert re.search(
        r"about \d+\.\d GiB of 80\.0 that are free, an update 0\.\d\d s or more, the run \d+\.\d hours",
        caplog.text,
    )


def test_the_papers_network_has_the_papers_size():
    """Its n encodings make 1 TFLOP a frame; three times that with gradients (reference arithmetic)."""
    cost = cost_of_update(with_schedule(PAPER, chunk_frames=1), VIEW)
    assert 3.0e12 < cost.network_flop < 5.0e12
    assert 10e6 < cost.parameters < 15e6


def test_the_demo_fits_a_laptop():
    assert budget.estimate(PRESETS["demo"], (256, 256)).memory < 2 * GIB
    assert budget.available_memory() is None or budget.available_memory() > 2**20


def test_rates_of_this_machine_are_those_of_a_machine():
    rates = measure_rates(torch.device("cpu"))
    assert 1e8 < rates.convolution < 1e13
    assert 1e8 < rates.product < 1e13
    assert 1e8 < rates.bandwidth < 1e13
    assert 1e3 < rates.launches < 1e8


def test_an_operation_takes_as_long_as_its_scarcest_resource():
    rates = DeviceRates(convolution=100.0, product=10.0, bandwidth=1000.0, launches=5.0)
    convolution, product = Operation("", "convolution", 300, 10), Operation("", "product", 300, 10)
    moved, small = Operation("", "elementwise", 0, 4000), Operation("", "elementwise", 0, 1)
    assert rates.seconds([convolution]) == 3.0
    assert rates.seconds([product, moved, small]) == 30.0 + 4.0 + 0.2


def test_larger_images_have_more_pairs_and_every_gaussian_has_one():
    assert 10_000 < estimate_pairs(10_000, (64, 64)) < estimate_pairs(10_000, (512, 512))
