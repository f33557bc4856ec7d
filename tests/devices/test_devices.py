"""A device is chosen once, by name, from those that are there."""

import pytest
import torch

from dsar.cli import parse
from dsar.devices import choose_device, send, takes_kernels
from dsar.errors import ConfigError
from tests.devices.host_waits import watch

COMMANDS = ("train", "check", "export", "render", "eval", "stress", "crosscheck")


@pytest.fixture
def gpus(monkeypatch):
    """Return what sets how many GPUs torch finds."""

    def find(count):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: count)

    return find


@pytest.mark.parametrize(
    ("count", "name", "expected"),
    [
        (0, "auto", "cpu"),
        (2, "auto", "cuda:0"),
        (2, "cpu", "cpu"),
        (2, "cuda", "cuda:0"),
        (2, "cuda:1", "cuda:1"),
    ],
)
def test_a_name_chooses_a_device_that_is_there(gpus, count, name, expected):
    gpus(count)
    assert choose_device(name) == torch.device(expected)


@pytest.mark.parametrize(
    ("count", "name", "words"),
    [
        (0, "cuda", "finds no GPU"),
        (1, "cuda:1", "torch finds 1"),
        (1, "cuda:", "cuda:N"),
        (1, "cuda:-1", "cuda:N"),
        (1, "mps", "expected auto, cpu, cuda"),
        (0, "", "expected auto, cpu, cuda"),
    ],
)
def test_a_device_that_is_not_there_is_refused_by_its_name(gpus, count, name, words):
    gpus(count)
    with pytest.raises(ConfigError, match=words) as caught:
        choose_device(name)
    assert f"--device {name}" in str(caught.value)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_takes_a_device(gpus, command):
    gpus(2)
    assert parse([command]).chosen_device() == torch.device("cuda:0")
    assert parse([command, "--device", "cuda:1"]).chosen_device() == torch.device("cuda:1")


def test_what_is_sent_to_a_device_makes_nobody_wait(device):
    numbers = torch.arange(3.0)
    assert send(numbers, torch.device("cpu")) is numbers
    with watch(allowed=False):
        there = send(numbers, device)
    assert torch.equal(there.cpu(), numbers)
    assert takes_kernels(numbers)
    assert not takes_kernels(there)
