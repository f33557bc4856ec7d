"""The pretended device, for the tests of this folder."""

import pytest
import torch

TORCH = "2.13."
"""The version on whose private interface the device rests."""


if torch.__version__.startswith(TORCH):
    from tests.devices.pretended_device import pretended_device

    # The first backward pass of a process fixes the devices that can have one: let this be the first.
    with pretended_device():
        torch.ones((), requires_grad=True).backward()


@pytest.fixture(scope="module")
def device():
    """Yield a device that is none of the host's; torch knows it while the module's tests run."""
    if not torch.__version__.startswith(TORCH):
        pytest.skip(f"the pretended device needs torch {TORCH}x, found {torch.__version__}")
    with pretended_device() as made:
        yield made
