"""The host without its compiled kernels: what the pretended device must agree with to the last bit."""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch


@contextmanager
def plain_torch() -> Iterator[None]:
    """Pose, rasterise and compare images in plain torch in a block, wherever tensors are."""
    with (
        patch("dsar.devices.KERNEL_DEVICES", frozenset()),
        patch("dsar.raster.backends._choose_backend", lambda *_: "reference"),
    ):
        yield
