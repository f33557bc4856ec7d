"""A decoder without convolutions: a few fixed maps and their mixture (Zhan et al. 2025)."""

from collections.abc import Sequence

from torch import Tensor, nn

from dsar.network.decoder import ResidualDecoder
from dsar.network.layers import SLOPE

_WIDTH = 128
"""Neurons in each hidden layer."""


class LinearBases(ResidualDecoder):
    """A few fixed maps, mixed as a small network says that sees the deepest features.

    Maps of whole garments leave no work per pixel but one sum; what they cannot show is left out.
    """

    def __init__(self, inputs: int, outputs: int, size: tuple[int, int], count: int) -> None:
        super().__init__()
        self.size = size
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

    def forward(self, features: Sequence[Tensor]) -> Tensor:
        """Return the mixture."""
        coefficients = self.layers(features[-1].flatten(1))
        return self.head(coefficients.to(self.head.weight.dtype)).unflatten(1, (-1, *self.size))
