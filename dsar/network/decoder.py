"""From the feature hierarchy to residual maps (paper equation 16), by convolutions or by linear bases."""

import itertools
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dsar.network.layers import SLOPE, ConvBlock, Upsample, conv

_WIDTH = 128
"""Neurons in each hidden layer of `LinearBases`."""


class Decoder(nn.Module):
    """U-Net decoder with a skip at every level; the head starts at zero, so step 0 is the template."""

    def __init__(self, channels: Sequence[int], outputs: int) -> None:
        super().__init__()
        pairs = list(itertools.pairwise(channels))
        self.ups = nn.ModuleList([Upsample(deep, shallow) for shallow, deep in pairs])
        self.blocks = nn.ModuleList([ConvBlock(2 * shallow, shallow) for shallow, _ in pairs])
        self.head = conv(channels[0], outputs)
        nn.init.zeros_(self.head.weight)

    def forward(self, features: Sequence[Float[Tensor, "b _ _ _"]]) -> Float[Tensor, "b o h w"]:
        """Return output maps at the resolution of the finest level; features are finest first."""
        x = features[-1]
        for level in reversed(range(len(self.ups))):
            x = self.ups[level](x)
            x = self.blocks[level](torch.cat([x, features[level]], 1))
        # In a rollout of 16-bit numbers the head alone keeps 32: a millimetre needs them.
        return self.head(x.to(self.head.weight.dtype))


class LinearBases(nn.Module):
    """A few fixed maps, mixed as a small network says that sees the deepest features (Zhan et al. 2025).

    Maps of whole garments leave no work per pixel but one sum; what they cannot show is left out.
    """

    def __init__(self, inputs: int, outputs: int, size: tuple[int, int], count: int) -> None:
        super().__init__()
        self.size = size
        self.ups = nn.ModuleList()
        self.layers = nn.Sequential(
            nn.Linear(inputs, _WIDTH),
            nn.LeakyReLU(SLOPE),
            nn.Linear(_WIDTH, _WIDTH),
            nn.LeakyReLU(SLOPE),
            nn.Linear(_WIDTH, count),
        )
        self.head = nn.Linear(count, outputs * size[0] * size[1])
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, features: Sequence[Float[Tensor, "b _ _ _"]]) -> Float[Tensor, "b o h w"]:
        """Return output maps at the resolution of the finest level; features are finest first."""
        shares = self.layers(features[-1].flatten(1))
        return self.head(shares.to(self.head.weight.dtype)).unflatten(1, (-1, *self.size))
