"""The encoder's convolutions: from a frame's inputs to features at every level."""

import itertools
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from dsar.network.layers import ConvBlock, activate, channels_last, conv


def level_size(grid: tuple[int, int], level: int) -> tuple[int, int]:
    """Return height and width of a level of the hierarchy, 0 the finest, which has the grid's."""
    return -(-grid[0] // 2**level), -(-grid[1] // 2**level)


class Pyramid(nn.Module):
    """Two convolutions at every level; every further level halves the grid (paper equation 5).

    Learned UV features are among the inputs. The first convolution, which is linear, takes them by
    themselves: they are the same for every frame and rollout.
    """

    def __init__(self, inputs: int, channels: Sequence[int], uv_features: int = 0) -> None:
        super().__init__()
        self.inputs = inputs
        self.first = conv(inputs + uv_features, channels[0])
        self.second = conv(channels[0], channels[0])
        pairs = itertools.pairwise(channels)
        self.deeper = nn.ModuleList(ConvBlock(shallow, deep, 2) for shallow, deep in pairs)

    def static_term(self, uv_features: Float[Tensor, "1 s h w"] | None) -> Float[Tensor, "_ c _ _"]:
        """Return what UV features and the bias add to the first convolution's sums, for any frame."""
        bias = self.first.bias[:, None, None]  # pyright: ignore[reportOptionalSubscript]
        if uv_features is None:
            return bias[None]
        weight = self.first.weight[:, self.inputs :]
        convolved = nn.functional.conv2d(channels_last(uv_features), weight, padding=1)
        return channels_last(convolved + bias)

    def first_convolution(self, inputs: Float[Tensor, "b i h w"], start: int = 0) -> Float[Tensor, "b c h w"]:
        """Return what the input channels from number `start` on add to the first convolution's sums."""
        weight = self.first.weight[:, start : start + inputs.shape[1]]
        return nn.functional.conv2d(channels_last(inputs), weight, padding=1)

    def features(self, first: Float[Tensor, "b c h w"]) -> list[Float[Tensor, "b _ _ _"]]:
        """Return the features f, finest level first, from the first convolution's, activated."""
        features = [activate(self.second(first))]
        for block in self.deeper:
            features.append(block(features[-1]))
        return features
