"""Training's step and the inference session against the paper's equations, forward and backward."""

import dataclasses

import pytest
import torch
from networks import SIZE, SMALL, VARIANTS, WIRINGS, build, inputs, roll
from reference_variants import ReferenceVariant, VariantRollout, fold_kernels

from dsar.network.reference import ReferenceNetwork, ReferenceRollout, fold_doubling
from dsar.network.session import InferenceSession

PAPER = dataclasses.replace(SMALL, wiring="shared", channels=(4, 8, 8))


def paper_network(**changes):
    network = build(dataclasses.replace(PAPER, **changes)).double()
    return network, ReferenceNetwork(network, fold_kernels(network))


def gradients(outputs, parameters):
    generator = torch.Generator().manual_seed(5)
    weights = torch.randn(len(outputs), 2, 3, *SIZE, generator=generator).double()
    loss = (torch.stack([output.offset for output in outputs]) * weights).sum()
    return torch.autograd.grad(loss, parameters)


def assert_close(one, other):
    assert (one.offset - other.offset).norm() <= 1e-9 * other.offset.norm()
    assert (one.appearance - other.appearance).norm() <= 1e-9 * other.appearance.norm()
    for feature, expected in zip(one.features, other.features, strict=True):
        assert (feature - expected).norm() <= 1e-9 * expected.norm()


@pytest.mark.parametrize("changes", [{}, {"uv_feature_channels": 0, "acceleration": False}, {"window": 1}])
def test_training_and_session_compute_the_papers_equations(changes):
    """Beyond the window and the bank."""
    network, reference = paper_network(**changes)
    maps, speed = (x.double() for x in inputs(network.config, 9))
    with torch.no_grad():
        trained, _ = roll(network, maps, speed)
        rollout, session = ReferenceRollout(reference), InferenceSession(network)
        for frame, output in enumerate(trained):
            expected = rollout.step(maps[frame], speed[frame])
            assert_close(output, expected)
            assert_close(session.step(maps[frame], speed[frame]), expected)
    assert expected.offset.abs().max() > 1e-3


def test_gradients_are_those_of_the_papers_equations():
    """Over rollouts from their first frame on, through offsets, window and bank, to every parameter."""
    network, reference = paper_network()
    maps, speed = (x.double() for x in inputs(network.config, 6))
    rollout = ReferenceRollout(reference)
    read = [rollout.step(*frame) for frame in zip(maps, speed, strict=True)]
    folded = [up.conv.weight for up in network.decoder.ups]
    shared = [p for p in network.parameters() if not any(p is weight for weight in folded)]
    kernels = list(reference.doubling_kernels)
    fast = gradients(roll(network, maps, speed)[0], shared + folded)
    slow = gradients(read, shared + kernels)
    for one, other in zip(fast[: len(shared)], slow, strict=False):
        assert (one - other).norm() <= 1e-9 * other.norm() + 1e-12
    # Folding is linear: a kernel's gradient is what folding carries back of the folded one's.
    for kernel, one, other in zip(kernels, fast[len(shared) :], slow[len(shared) :], strict=True):
        _, carried = torch.autograd.functional.vjp(fold_doubling, kernel.detach(), one)
        assert (carried - other).norm() <= 1e-9 * other.norm()


def test_motion_magnitude_is_the_length_of_the_velocity():
    velocity = torch.zeros(2, 3, 4, 5)
    velocity[1, :, 2, 3] = torch.tensor([2.0, 3.0, 6.0])
    magnitude = ReferenceNetwork.motion_magnitude(velocity)
    assert magnitude.shape == (2, 1, 4, 5)
    assert magnitude[1, 0, 2, 3] == 7
    assert magnitude.sum() == 7


@pytest.mark.parametrize("wiring", WIRINGS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_caching_changes_nothing(wiring, variant):
    """In all variants the reference, training and a session agree, beyond the window and the bank."""
    config = dataclasses.replace(SMALL, wiring=wiring, **VARIANTS[variant])
    network = build(config).double()
    reference = ReferenceVariant(network, fold_kernels(network))
    maps, speed = (x.double() for x in inputs(config, 9))
    with torch.no_grad():
        trained, _ = roll(network, maps, speed)
        slow, fast = VariantRollout(reference), InferenceSession(network)
        for frame, expected in enumerate(trained):
            assert_close(slow.step(maps[frame], speed[frame]), expected)
            assert_close(fast.step(maps[frame], speed[frame]), expected)
    assert expected.offset.abs().max() > 1e-3


@pytest.mark.parametrize("wiring", WIRINGS)
def test_gradients_of_all_wirings_are_those_of_the_reference(wiring):
    config = dataclasses.replace(SMALL, wiring=wiring)
    network = build(config).double()
    rollout = VariantRollout(ReferenceVariant(network, fold_kernels(network)))
    maps, speed = (x.double() for x in inputs(config, 6))
    # Folded kernels are sums of the reference's.
    folded = {id(up.conv.weight) for up in network.decoder.ups}
    parameters = [p for p in network.parameters() if id(p) not in folded]
    read = [rollout.step(*frame) for frame in zip(maps, speed, strict=True)]
    fast, slow = gradients(roll(network, maps, speed)[0], parameters), gradients(read, parameters)
    for one, other in zip(fast, slow, strict=True):
        assert (one - other).norm() <= 1e-9 * other.norm() + 1e-12


@pytest.mark.parametrize("changes", [{"bases": 4}, {"channels": (8,)}], ids=["bases", "one level"])
def test_sessions_of_the_smallest_networks_take_the_steps_of_training(changes):
    config = dataclasses.replace(SMALL, **changes)
    network, (maps, speed) = build(config).double(), (x.double() for x in inputs(config, 8))
    expected, _ = roll(network, maps, speed)
    session = InferenceSession(network)
    for frame, output in enumerate(expected):
        made = session.step(maps[frame], speed[frame])
        assert torch.allclose(made.offset, output.offset, atol=1e-12)
        assert torch.allclose(made.appearance, output.appearance, atol=1e-12)
    assert expected[-1].offset.abs().max() > 1e-3
