"""A network whose weights no longer change, laid out for speed: what an inference session runs."""

import copy
import itertools

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dsar.devices import takes_kernels
from dsar.network.decoder import Decoder
from dsar.network.layers import Upsample, activate, channels_last
from dsar.network.model import DualStreamNetwork
from dsar.network.temporal import TemporalAttention

_SMALL_GRID = 1024
"""Pixels of a network's finest level up to which `ShuffledUpsample` is faster on a CPU."""

_CHANNEL_MULTIPLE = 16
"""On such levels a matrix product of 14 columns takes half as long again as one of 16."""


class ShuffledUpsample(nn.Module):
    """An `Upsample` as a 3x3 convolution to four times the channels, which become the pixels of a cell.

    More than half of its kernel is zero. Yet on grids of a few hundred pixels, one rollout at a time, it
    takes half the time of a transposed convolution.
    """

    def __init__(self, upsample: Upsample) -> None:
        super().__init__()
        weight, bias = upsample.conv.weight, upsample.conv.bias
        inputs, outputs = weight.shape[:2]
        # For each parity of an output pixel: where a tap is in this kernel, and where in the transposed one.
        taps = (((0, 3), (1, 1)), ((1, 2), (2, 0)))
        kernel = weight.new_zeros(outputs, 2, 2, inputs, 3, 3)
        for (a, rows), (b, columns) in itertools.product(enumerate(taps), enumerate(taps)):
            for (y, row), (x, column) in itertools.product(rows, columns):
                kernel[:, a, b, :, y, x] = weight.detach()[:, :, row, column].T
        self.weight = nn.Parameter(kernel.reshape(-1, inputs, 3, 3))
        assert bias is not None
        self.bias = nn.Parameter(bias.detach().repeat_interleave(4))

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h2 w2"]:
        """Return features at twice the resolution."""
        x = nn.functional.conv2d(x, self.weight, self.bias, padding=1)
        return nn.functional.pixel_shuffle(activate(x), 2)


def frozen_copy(network: DualStreamNetwork, precision: torch.dtype | None) -> DualStreamNetwork:
    """Return a copy of a network as convolutions without gradients like it best.

    With a `precision` it computes in those numbers, its head excepted.
    """
    network = copy.deepcopy(network)
    small = network.grid[0] * network.grid[1] <= _SMALL_GRID
    if takes_kernels(network.occupied) and small and isinstance(network.decoder, Decoder):
        ups = [up for up in network.decoder.ups if isinstance(up, Upsample)]
        network.decoder.ups = nn.ModuleList(map(ShuffledUpsample, ups))
        head = network.decoder.head
        # Cells' pixels are told apart by the number of channels.
        if network.config.pixel_shuffle == 1 and isinstance(head, nn.Conv2d):
            _pad_outputs(head)
    if precision is not None:
        network = network.to(precision)
        network.decoder.head.float()
    for parameter in network.parameters():
        if parameter.ndim == 4:
            parameter.data = channels_last(parameter.data)
    for module in network.modules():
        if isinstance(module, TemporalAttention):
            module.freeze()
    return network


def _pad_outputs(layer: nn.Conv2d) -> None:
    """Add output channels that are zero, up to a multiple of _CHANNEL_MULTIPLE."""
    missing = -layer.out_channels % _CHANNEL_MULTIPLE
    assert layer.bias is not None
    layer.weight.data = nn.functional.pad(layer.weight, (0, 0, 0, 0, 0, 0, 0, missing))
    layer.bias.data = nn.functional.pad(layer.bias, (0, missing))
