"""The pretended device, for the tests of this folder."""

import pytest
import torch

TORCH = "2.13."
"""The version on whose private interface the device rests."""


@pytest.fixture(scope="module")
def device():
    """Yield a device that is none of the host's; torch knows it while the module's tests run."""
    if not torch.__version__.startswith(TORCH):
        pytest.skip(f"the pretended device needs torch {TORCH}x, found {torch.__version__}")
    from tests.devices.pretended_device import pretended_device

    with pretended_device() as made:
        yield made
