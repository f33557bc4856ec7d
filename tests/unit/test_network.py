"""The network against its literal definition, and what must hold of any autoregression."""

import dataclasses

import pytest
import torch

from dsar.config import ModelConfig
from dsar.network import DualStreamNetwork, NetworkState
from dsar.network.temporal import TemporalAttention

SMALL = ModelConfig(window=4, memory=3, channels=(4, 8), heads=2, identity_channels=2)
SIZE = (8, 6)


@pytest.fixture(params=["perframe", "shared"])
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
    state = state or network.start(maps.shape[1])
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
    for wiring in ("shared", "perframe"):
        config = dataclasses.replace(SMALL, wiring=wiring, feedback=False)
        made, _ = roll(build(config), *inputs(config, 9))
        outputs.append(torch.stack([o.offset for o in made]))
    assert torch.allclose(outputs[0], outputs[1], atol=1e-6)
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
    one, _ = roll(network, maps, speed, streams=False)
    two, _ = roll(network, other, speed, streams=False)
    assert torch.allclose(one[-1].offset, two[-1].offset, atol=1e-6)
    assert (one[2].offset - two[2].offset).abs().max() > 1e-4


@pytest.mark.parametrize(("feedback", "memory"), [(True, 0), (False, 3)], ids=["geometric", "state"])
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
    state = network.start(2).map(lambda t: t.clone())
    state = dataclasses.replace(
        state,
        fresh=torch.zeros_like(state.fresh),
        offset=state.offset.requires_grad_(),
        memory=state.memory.requires_grad_(),
    )
    outputs, _ = roll(network, maps, speed, state)
    outputs[-1].offset.square().sum().backward()
    assert state.offset.grad.abs().max() > 0
    assert state.memory.grad.abs().max() > 0
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


def test_offsets_stay_inside_the_guard_and_outside_charts_are_zero(wiring):
    config = dataclasses.replace(SMALL, wiring=wiring)
    network, (maps, speed) = build(config), inputs(config, 20)
    outputs, _ = roll(network, 100 * maps, speed)
    offset = outputs[-1].offset
    assert offset.abs().max() <= config.offset_limit
    assert offset[:, :, 0, :2].abs().max() == 0


def test_one_query_is_the_last_row_of_causal_self_attention():
    torch.manual_seed(0)
    attention = TemporalAttention(8, 2, 5).double()
    frames = torch.randn(2, 5, 8, 3, 4, dtype=torch.float64)
    fast = attention(frames[:, -1], frames)

    tokens = frames + attention.age[:, :, None, None]

    def project(layer, x):
        return layer(x.flatten(0, 1)).reshape(2, 5, 2, 4, 3, 4)

    # The newest frame asks without its age, as in the fast path: the age is the key's.
    q, k, v = (
        project(attention.query, frames),
        project(attention.key, tokens),
        project(attention.value, tokens),
    )
    scores = torch.einsum("bthcyx,bshcyx->bhtsyx", q, k) / 2
    mask = torch.ones(5, 5).tril().bool()[None, None, :, :, None, None]
    mixed = torch.einsum("bhtsyx,bshcyx->bthcyx", scores.masked_fill(~mask, -torch.inf).softmax(3), v)
    literal = attention.out(mixed[:, -1].reshape(2, 8, 3, 4))
    assert torch.allclose(fast, literal, atol=1e-12)
