"""The inference session: ablated, in 16 bits, recorded on a GPU, and set back to where it was."""

import dataclasses

import pytest
import torch
from networks import SMALL, VARIANTS, WIRINGS, build, inputs, roll

from dsar.network import STREAMS
from dsar.network.session import InferenceSession

FRAMES = 9
RESTORED = ("paper", "three offsets", "no bank", "bank of features", "mean of rows", "no motion embedding")


@pytest.fixture(params=WIRINGS)
def wiring(request):
    return request.param


def copies(output):
    """Return an output's tensors as they are now."""
    return [tensor.clone() for tensor in (output.offset, output.appearance, *output.features)]


def assert_same_bytes(output, expected):
    for one, other in zip(copies(output), expected, strict=True):
        assert torch.equal(one, other)


def run_with_snapshots(session, maps, speed):
    """Return what a session makes of each frame, and snapshots: before the first, then after each."""
    outputs, snapshots = [], [session.snapshot()]
    for m, v in zip(maps, speed, strict=True):
        outputs.append(copies(session.step(m, v)))
        snapshots.append(session.snapshot())
    return outputs, snapshots


@pytest.mark.parametrize("stream", STREAMS)
def test_a_stream_taken_away_in_a_session_is_one_that_training_leaves_out(wiring, stream):
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


def test_sixteen_bits_are_enough_for_a_session():
    network, (maps, speed) = build(SMALL), inputs(SMALL, 40)
    exact, short = InferenceSession(network), InferenceSession(network, precision=torch.bfloat16)
    error, size = 0.0, 0.0
    for m, v in zip(maps, speed, strict=True):
        one, other = exact.step(m, v).offset, short.step(m, v).offset
        assert other.dtype == torch.float32
        error, size = error + float((one - other).square().sum()), size + float(one.square().sum())
    assert error < 0.02**2 * size
    assert network.decoder.head.weight.dtype == torch.float32


def test_a_session_keeps_the_weights_that_it_began_with():
    network, (maps, speed) = build(SMALL), inputs(SMALL, 6)
    expected = [copies(InferenceSession(network).step(maps[0], speed[0]))]
    session = InferenceSession(network)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(1.0)
    assert_same_bytes(session.step(maps[0], speed[0]), expected[0])


@pytest.mark.parametrize("variant", RESTORED)
def test_after_restore_the_next_steps_are_byte_for_byte_those_that_followed(wiring, variant):
    """From every frame of the window and beyond, in the session itself and in one that has seen nothing."""
    config = dataclasses.replace(SMALL, wiring=wiring, **VARIANTS[variant])
    network, (maps, speed) = build(config), inputs(config, FRAMES)
    session = InferenceSession(network)
    outputs, snapshots = run_with_snapshots(session, maps, speed)
    assert (outputs[-1][0] - outputs[-2][0]).abs().max() > 1e-4
    for start, snapshot in reversed(list(enumerate(snapshots))):
        for restored in (session, InferenceSession(network)):
            restored.restore(snapshot)
            for frame in range(start, FRAMES):
                assert_same_bytes(restored.step(maps[frame], speed[frame]), outputs[frame])


@pytest.mark.parametrize("options", [{"streams": ("geometric",)}, {"precision": torch.bfloat16}])
def test_ablated_and_short_sessions_are_restored_too(options):
    network, (maps, speed) = build(SMALL), inputs(SMALL, FRAMES)
    session = InferenceSession(network, **options)
    outputs, snapshots = run_with_snapshots(session, maps, speed)
    session.restore(snapshots[2])
    for frame in range(2, FRAMES):
        assert_same_bytes(session.step(maps[frame], speed[frame]), outputs[frame])


def test_a_snapshot_shares_nothing_with_its_session(wiring):
    """Neither later steps nor a restored session's change it; what it was restored into is its own."""
    config = dataclasses.replace(SMALL, wiring=wiring)
    network, (maps, speed) = build(config), inputs(config, FRAMES)
    session = InferenceSession(network)
    session.step(maps[0], speed[0])
    snapshot = session.snapshot()
    tensors = [snapshot.offsets, *snapshot.newest, *(ring for ring in snapshot.rings if ring is not None)]
    before = [tensor.clone() for tensor in tensors]
    other = InferenceSession(network)
    other.restore(snapshot)
    for m, v in zip(maps[1:], speed[1:], strict=True):
        session.step(m, v)
        other.step(m + 1, v)
    session.restore(snapshot)
    session.step(maps[1], speed[1])
    for tensor, expected in zip(tensors, before, strict=True):
        assert torch.equal(tensor, expected)


@pytest.mark.gpu
@pytest.mark.parametrize("variant", ["paper", "mean of rows", "no bank"])
def test_a_recorded_session_is_the_one_of_the_cpu(wiring, variant):
    """One CUDA graph is replayed for all steps after the first, wherever in the rings the newest frame is."""
    config = dataclasses.replace(SMALL, wiring=wiring, **VARIANTS[variant])
    network, (maps, speed) = build(config), inputs(config, 20)
    slow, recorded = InferenceSession(network), InferenceSession(network.cuda())
    for m, v in zip(maps, speed, strict=True):
        expected, found = slow.step(m, v).offset, recorded.step(m.cuda(), v.cuda()).offset
        assert torch.allclose(found.cpu(), expected, atol=1e-5)
    assert recorded._graph is not None
    assert expected.abs().max() > 1e-3


@pytest.mark.gpu
def test_a_recorded_session_is_restored_into_the_storage_that_it_reads(wiring):
    config = dataclasses.replace(SMALL, wiring=wiring)
    network, (maps, speed) = build(config).cuda(), (x.cuda() for x in inputs(config, FRAMES))
    session = InferenceSession(network)
    outputs, snapshots = run_with_snapshots(session, maps, speed)
    graph = session._graph
    assert graph is not None
    for start in (6, 1, 0, 4):
        session.restore(snapshots[start])
        for frame in range(start, FRAMES):
            for one, other in zip(
                copies(session.step(maps[frame], speed[frame])), outputs[frame], strict=True
            ):
                assert torch.allclose(one, other, atol=1e-5)
    assert session._graph is graph
