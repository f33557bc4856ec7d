"""The network against its literal definition, and what must hold of any autoregression."""

import dataclasses

import pytest
import torch
from literal_network import LiteralNetwork, LiteralRollout

from dsar.config import ModelConfig
from dsar.network import STREAMS, DualStreamNetwork, NetworkState
from dsar.network.session import InferenceSession

SMALL = ModelConfig(window=4, memory=3, channels=(4, 8), heads=2, uv_feature_channels=2)
SIZE = (8, 12)


@pytest.fixture(params=["perframe", "late", "shared"])
def wiring(request):
    return request.param


def build(config: ModelConfig, *, trained: bool = True) -> DualStreamNetwork:
    torch.manual_seed(0)
    occupied = torch.ones(SIZE, dtype=torch.bool)
    occupied[0, :2] = False
    network = DualStreamNetwork(config, occupied)
    if trained:
        torch.nn.init.normal_(network.decoder.head.weight, std=0.1)
    return network


def inputs(config: ModelConfig, frames: int, batch: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    maps = torch.randn(frames, batch, config.map_channels, *SIZE, generator=generator)
    speed = torch.rand(frames, batch, 1, *SIZE, generator=generator)
    return maps, speed


def roll(network, maps, speed, state: NetworkState | None = None, **options):
    state = state or network.initial_state(maps.shape[1])
    outputs = []
    for frame in range(len(maps)):
        output, state = network(maps[frame], speed[frame], state, **options)
        outputs.append(output)
    return outputs, state


def test_an_untrained_network_leaves_the_template_alone(wiring):
    config = dataclasses.replace(SMALL, wiring=wiring)
    outputs, _ = roll(build(config, trained=False), *inputs(config, 3))
    for output in outputs:
        assert output.offset.abs().max() == 0
        assert output.appearance.abs().max() == 0


def test_caching_encodings_is_exact_where_no_feedback_enters_them():
    outputs = []
    for wiring in ("shared", "late", "perframe"):
        config = dataclasses.replace(SMALL, wiring=wiring, feedback=0)
        made, _ = roll(build(config), *inputs(config, 9))
        outputs.append(torch.stack([o.offset for o in made]))
    for other in outputs[1:]:
        assert torch.allclose(outputs[0], other, atol=1e-6)
    assert outputs[0].abs().max() > 1e-3


def test_rollouts_of_a_batch_do_not_see_each_other(wiring):
    config = dataclasses.replace(SMALL, wiring=wiring)
    network, (maps, speed) = build(config), inputs(config, 6)
    together, _ = roll(network, maps, speed)
    alone, _ = roll(network, maps[:, 1:], speed[:, 1:])
    assert torch.allclose(together[-1].offset[1:], alone[-1].offset, atol=1e-6)


def test_a_restarted_rollout_equals_a_fresh_one_and_leaves_the_other_alone(wiring):
    config = dataclasses.replace(SMALL, wiring=wiring)
    network, (maps, speed) = build(config), inputs(config, 6)
    _, state = roll(network, maps, speed)
    restarted, _ = roll(network, maps, speed, state.restart(torch.tensor([True, False])))
    went_on, _ = roll(network, maps, speed, state)
    fresh, _ = roll(network, maps, speed)
    for a, b, c in zip(restarted, fresh, went_on, strict=True):
        assert torch.allclose(a.offset[0], b.offset[0], atol=1e-6)
        assert torch.allclose(a.offset[1], c.offset[1], atol=1e-6)
    assert (went_on[0].offset[0] - fresh[0].offset[0]).abs().max() > 1e-4


def test_without_streams_the_past_beyond_the_window_is_invisible(wiring):
    config = dataclasses.replace(SMALL, wiring=wiring)
    network, (maps, speed) = build(config), inputs(config, 10)
    other = maps.clone()
    other[:3] += 1.0
    one, _ = roll(network, maps, speed, streams=())
    two, _ = roll(network, other, speed, streams=())
    assert torch.allclose(one[-1].offset, two[-1].offset, atol=1e-6)
    assert (one[2].offset - two[2].offset).abs().max() > 1e-4


STREAM_SIZES = {"geometric": (1, 0), "three offsets": (3, 0), "state": (0, 3)}


@pytest.mark.parametrize(("feedback", "memory"), STREAM_SIZES.values(), ids=STREAM_SIZES)
def test_each_stream_alone_carries_the_past_beyond_the_window(wiring, feedback, memory):
    config = dataclasses.replace(SMALL, wiring=wiring, feedback=feedback, memory=memory)
    network, (maps, speed) = build(config), inputs(config, 10)
    other = maps.clone()
    other[:3] += 1.0
    one, _ = roll(network, maps, speed)
    two, _ = roll(network, other, speed)
    assert (one[-1].offset - two[-1].offset).abs().max() > 1e-7


def test_gradients_reach_both_streams_through_time(wiring):
    config = dataclasses.replace(SMALL, wiring=wiring)
    network, (maps, speed) = build(config), inputs(config, 3)
    state = network.initial_state(2).map(lambda t: t.clone())
    state = dataclasses.replace(
        state,
        fresh=torch.zeros_like(state.fresh),
        offsets=state.offsets.requires_grad_(),
        memory=state.memory.requires_grad_(),
    )
    outputs, _ = roll(network, maps, speed, state)
    outputs[-1].offset.square().sum().backward()
    assert state.offsets.grad.abs().max() > 0
    assert state.memory.grad.abs().max() > 0
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


def test_offsets_stay_inside_the_guard_and_outside_charts_are_zero(wiring):
    config = dataclasses.replace(SMALL, wiring=wiring)
    network, (maps, speed) = build(config), inputs(config, 20)
    outputs, _ = roll(network, 100 * maps, speed)
    offset = outputs[-1].offset
    assert offset.abs().max() <= config.offset_limit
    assert offset[:, :, 0, :2].abs().max() == 0


VARIANTS = {
    "paper": {},
    "three offsets": {"feedback": 3},
    "no offsets": {"feedback": 0},
    "no bank": {"memory": 0},
    "bank of features": {"bank": "features", "memory": 1},
    "mean of rows": {"readout": "mean"},
    "bidirectional": {"readout": "mean", "causal": False},
    "no motion embedding": {"motion_embedding": False},
    "no identities": {"uv_feature_channels": 0},
    "pixel shuffle": {"pixel_shuffle": 2},
    "one frame": {"window": 1},
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_is_saved_changes_nothing(wiring, variant):
    """A literal reading, training's steps and a session's agree, beyond the window and the bank."""
    config = dataclasses.replace(SMALL, wiring=wiring, **VARIANTS[variant])
    network = build(config).double()
    literal = LiteralNetwork(network)
    maps, speed = (x.double() for x in inputs(config, 9))
    with torch.no_grad():
        trained, _ = roll(network, maps, speed)
        slow, fast = LiteralRollout(literal), InferenceSession(network)
        for frame, expected in enumerate(trained):
            read = slow.step(maps[frame], speed[frame])
            kept = fast.step(maps[frame], speed[frame])
            for output in (read, kept):
                assert (output.offset - expected.offset).norm() <= 1e-9 * expected.offset.norm()
                assert (output.appearance - expected.appearance).norm() <= 1e-9 * expected.appearance.norm()
    assert expected.offset.abs().max() > 1e-3


ABLATIONS = {
    # What changes, and whose parameters come, go or change their size with it.
    "without GeoStream": ({"feedback": 0}, {"encoder.pyramid.first.weight"}),
    "three offsets": ({"feedback": 3}, {"encoder.pyramid.first.weight"}),
    "without StateStream": ({"memory": 0}, {"bank."}),
    "direct attention": ({"memory": 1, "bank": "features"}, {"bank.attention.position_embedding"}),
    "without velocity": ({"velocity": False}, {"encoder.pyramid.first.weight"}),
    "without acceleration": ({"acceleration": False}, {"encoder.pyramid.first.weight"}),
    "without lags": ({"mean_time_constants": ()}, {"encoder.pyramid.first.weight"}),
    "without motion embedding": ({"motion_embedding": False}, {"motion_embedding."}),
    "mean of rows": ({"readout": "mean"}, set()),
    "bidirectional": ({"readout": "mean", "causal": False}, set()),
    "linear bases": ({"bases": 4}, {"decoder."}),
    "longer": (
        {"window": 6, "memory": 5},
        {"attention.position_embedding", "bank.attention.position_embedding", "aggregation.0.weights"},
    ),
}


FIRST = "encoder.pyramid.first.weight"


def kept_maps(config):
    """Return which channels of SMALL's maps another configuration has: position, then what it switches."""
    switched = {
        "velocity": config.velocity,
        "acceleration": config.acceleration,
        "mean_time_constants": bool(config.mean_time_constants),
    }
    groups = {"velocity": range(3, 6), "acceleration": range(6, 9), "mean_time_constants": range(9, 18)}
    return [0, 1, 2, *(channel for name, group in groups.items() if switched[name] for channel in group)]


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_changes_its_part_and_the_output(name):
    changes, expected = ABLATIONS[name]
    config = dataclasses.replace(SMALL, **changes)
    full, ablated = build(SMALL), build(config)
    shapes, others = ({k: v.shape for k, v in n.named_parameters()} for n in (full, ablated))
    changed = {key for key in shapes.keys() | others.keys() if shapes.get(key) != others.get(key)}
    assert all(any(key.startswith(part) for part in expected) for key in changed)
    assert all(any(key.startswith(part) for key in changed) for part in expected)

    weights = full.state_dict()
    same = {key: value for key, value in weights.items() if key not in changed}
    assert not ablated.load_state_dict(same, strict=False).unexpected_keys
    maps, speed = inputs(SMALL, 8)
    kept = kept_maps(config)
    if FIRST in changed:
        # The inputs that stay keep their weights, so what differs is due to those that went or came.
        first = weights[FIRST]
        offsets = first[:, SMALL.map_channels : SMALL.map_channels + 3]
        parts = [first[:, kept], *[offsets] * config.feedback, first[:, -SMALL.uv_feature_channels :]]
        ablated.encoder.pyramid.first.weight.data = torch.cat(parts, 1)
    one, _ = roll(full, maps, speed)
    two, _ = roll(ablated, maps[:, :, kept], speed)
    assert (one[-1].offset - two[-1].offset).abs().max() > 1e-6
    # And what was taken away is not seen: with it zero in the full network too, both are one.
    if len(kept) < SMALL.map_channels:
        gone = torch.ones(SMALL.map_channels)[:, None, None]
        gone[kept] = 0
        blind, _ = roll(full, maps * (1 - gone), speed)
        assert torch.allclose(blind[-1].offset, two[-1].offset, atol=1e-6)


@pytest.mark.parametrize("changes", [{"bases": 4}, {"channels": (8,)}], ids=["bases", "one level"])
def test_rollouts_of_the_smallest_networks_are_those_of_training(changes):
    config = dataclasses.replace(SMALL, **changes)
    network, (maps, speed) = build(config).double(), (x.double() for x in inputs(config, 8))
    expected, _ = roll(network, maps, speed)
    session = InferenceSession(network)
    for frame, output in enumerate(expected):
        made = session.step(maps[frame], speed[frame])
        assert torch.allclose(made.offset, output.offset, atol=1e-12)
        assert torch.allclose(made.appearance, output.appearance, atol=1e-12)
    assert expected[-1].offset.abs().max() > 1e-3


def test_rows_that_see_the_future_differ_from_causal_ones():
    causal = dataclasses.replace(SMALL, readout="mean")
    free = dataclasses.replace(causal, causal=False)
    outputs = [roll(build(config), *inputs(SMALL, 8))[0][-1].offset for config in (causal, free)]
    assert (outputs[0] - outputs[1]).abs().max() > 1e-6


@pytest.mark.parametrize("stream", STREAMS)
def test_a_stream_taken_away_in_a_rollout_is_one_that_training_leaves_out(wiring, stream):
    config = dataclasses.replace(SMALL, wiring=wiring)
    network, (maps, speed) = build(config).double(), (x.double() for x in inputs(config, 8))
    both, rest = (
        InferenceSession(network),
        InferenceSession(network, tuple(s for s in STREAMS if s != stream)),
    )
    outputs = [
        [session.step(m, v).offset for m, v in zip(maps, speed, strict=True)] for session in (both, rest)
    ]
    without, _ = roll(network, maps, speed, streams=rest.streams)
    for alone, trained in zip(outputs[1], without, strict=True):
        assert torch.allclose(alone, trained.offset, atol=1e-12)
    assert (outputs[0][-1] - outputs[1][-1]).abs().max() > 1e-6


def test_sixteen_bits_are_enough_for_a_rollout():
    network, (maps, speed) = build(SMALL), inputs(SMALL, 40)
    exact, short = InferenceSession(network), InferenceSession(network, precision=torch.bfloat16)
    error, size = 0.0, 0.0
    for m, v in zip(maps, speed, strict=True):
        one, other = exact.step(m, v).offset, short.step(m, v).offset
        assert other.dtype == torch.float32
        error, size = error + float((one - other).square().sum()), size + float(one.square().sum())
    assert error < 0.02**2 * size
    assert network.decoder.head.weight.dtype == torch.float32


@pytest.mark.gpu
@pytest.mark.parametrize("variant", ["paper", "mean of rows", "no bank"])
def test_a_recorded_rollout_is_the_one_of_the_cpu(wiring, variant):
    """One CUDA graph is replayed for all steps after the first, wherever in the rings the newest frame is."""
    config = dataclasses.replace(SMALL, wiring=wiring, **VARIANTS[variant])
    network, (maps, speed) = build(config), inputs(config, 20)
    slow, recorded = InferenceSession(network), InferenceSession(network.cuda())
    for m, v in zip(maps, speed, strict=True):
        expected, found = slow.step(m, v).offset, recorded.step(m.cuda(), v.cuda()).offset
        assert torch.allclose(found.cpu(), expected, atol=1e-5)
    assert recorded._graph is not None
    assert expected.abs().max() > 1e-3


def test_gradients_are_those_of_the_literal_reading(wiring):
    """Over rollouts from their first frame on, through offsets, window and bank."""
    config = dataclasses.replace(SMALL, wiring=wiring)
    network = build(config).double()
    literal = LiteralNetwork(network)
    maps, speed = (x.double() for x in inputs(config, 6))
    # Folded kernels are sums of the literal ones.
    folded = {id(up.conv.weight) for up in network.decoder.ups}
    parameters = [p for p in network.parameters() if id(p) not in folded]
    weights = torch.randn(6, 2, 3, *SIZE, generator=torch.Generator().manual_seed(5)).double()
    rollout = LiteralRollout(literal)
    read = [rollout.step(*frame) for frame in zip(maps, speed, strict=True)]
    gradients = []
    for outputs in (roll(network, maps, speed)[0], read):
        loss = (torch.stack([output.offset for output in outputs]) * weights).sum()
        gradients.append(torch.autograd.grad(loss, parameters))
    for fast, slow in zip(*gradients, strict=True):
        assert (fast - slow).norm() <= 1e-9 * slow.norm() + 1e-12
