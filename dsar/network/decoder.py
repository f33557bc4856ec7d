"""From the feature hierarchy F to residual maps."""

import itertools
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dsar.network.layers import ConvBlock, Upsample, conv


class ResidualDecoder(nn.Module):
    """What all decoders have: a last layer, the head, which starts at zero, so step 0 is the template."""

    head: nn.Conv2d | nn.Linear

    def forward(self, features: Sequence[Float[Tensor, "b _ _ _"]]) -> Float[Tensor, "b o h w"]:
        """Return output maps at the resolution of the finest level; features are finest first."""
        raise NotImplementedError


class Decoder(ResidualDecoder):
    """Psi_dec: a U-Net decoder with a skip at every level, dG = Psi_dec(F) (paper equation 16)."""

    def __init__(self, channels: Sequence[int], outputs: int) -> None:
        super().__init__()
        pairs = list(itertools.pairwise(channels))
        self.ups = nn.ModuleList([Upsample(deep, shallow) for shallow, deep in pairs])
        self.blocks = nn.ModuleList([ConvBlock(2 * shallow, shallow) for shallow, _ in pairs])
        self.head = conv(channels[0], outputs)
        nn.init.zeros_(self.head.weight)

    def forward(self, features: Sequence[Tensor]) -> Tensor:
        """Return the head's maps of the last block."""
        x = features[-1]
        for level in reversed(range(len(self.ups))):
            x = self.ups[level](x)
            x = self.blocks[level](torch.cat([x, features[level]], 1))
        # In a session of 16-bit numbers the head alone keeps 32: a millimetre needs them.
        return self.head(x.to(self.head.weight.dtype))
