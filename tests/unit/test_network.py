"""What must hold of any autoregression, and of each ablation."""

import dataclasses

import pytest
import torch
from networks import SMALL, WIRINGS, build, inputs, roll


@pytest.fixture(params=WIRINGS)
def wiring(request):
    return request.param


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


ABLATIONS = {
    # What changes, and whose parameters come, go or change their size with it.
    "without GeoStream": ({"feedback": 0}, {"encoder.pyramid.first.weight"}),
    "three offsets": ({"feedback": 3}, {"encoder.pyramid.first.weight"}),
    "without StateStream": ({"memory": 0}, {"bank."}),
    "direct attention": ({"memory": 1, "bank": "features"}, {"bank.attention.position_embedding"}),
    "without velocity": ({"velocity": False}, {"encoder.pyramid.first.weight"}),
    "without acceleration": ({"acceleration": False}, {"encoder.pyramid.first.weight"}),
    "without running means": ({"mean_time_constants": ()}, {"encoder.pyramid.first.weight"}),
    "without motion prior": ({"prior": "none"}, {"encoder.pyramid.first.weight"}),
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
    groups = (
        (config.velocity, range(3, 6)),
        (config.acceleration, range(6, 9)),
        (bool(config.mean_time_constants), range(9, 18)),
        (config.prior == "cloth", range(18, 24)),
    )
    return [0, 1, 2, *(channel for present, group in groups if present for channel in group)]


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


def test_rows_that_see_the_future_differ_from_causal_ones():
    causal = dataclasses.replace(SMALL, readout="mean")
    free = dataclasses.replace(causal, causal=False)
    outputs = [roll(build(config), *inputs(SMALL, 8))[0][-1].offset for config in (causal, free)]
    assert (outputs[0] - outputs[1]).abs().max() > 1e-6


@pytest.mark.parametrize("streams", [("geometric", "state"), ()])
def test_recomputed_activations_give_the_same_gradients_to_the_bit(wiring, streams):
    config = dataclasses.replace(SMALL, wiring=wiring)
    maps, speed = inputs(config, 5)
    gradients = []
    for recomputes in (False, True):
        network = build(config)
        network.recomputes = recomputes
        outputs, state = roll(network, maps, speed, streams=streams)
        losses = [sum(o.offset.square().sum() + o.features[0].square().sum() for o in outputs)]
        losses.append(sum(o.appearance.square().sum() for o in outputs))
        weight = network.encoder.pyramid.first.weight
        # Losses are compared by their gradients before all go back together.
        apart = [torch.autograd.grad(loss, weight, retain_graph=True)[0] for loss in losses]
        sum(losses).backward()
        whole = [p.grad for p in network.parameters() if p.grad is not None]
        gradients.append([*apart, *whole, *(o.offset.detach() for o in outputs), state.memory.detach()])
    assert len(gradients[0]) == len(gradients[1]) > 20
    assert all(torch.equal(kept, again) for kept, again in zip(*gradients, strict=True))
