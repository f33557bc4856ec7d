"""Convolutional building blocks, initialised so that activations keep their variance (He et al. 2015)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

SLOPE = 0.2
"""Negative slope of every leaky ReLU."""


def conv(in_channels: int, out_channels: int, size: int = 3, stride: int = 1) -> nn.Conv2d:
    """Return a same-size (or stride-reduced) convolution with He initialisation and zero bias.

    PyTorch's default initialisation lets activations of this network fade to 2 % and its inner
    gradients below Adam's epsilon, so that nothing is learnt.
    """
    layer = nn.Conv2d(in_channels, out_channels, size, stride, size // 2)
    nn.init.kaiming_normal_(layer.weight, a=SLOPE, nonlinearity="leaky_relu")
    nn.init.zeros_(layer.bias)  # pyright: ignore[reportArgumentType]
    return layer


def projection(in_channels: int, out_channels: int) -> nn.Conv2d:
    """Return a per-pixel linear map that preserves variance (no non-linearity follows it)."""
    layer = nn.Conv2d(in_channels, out_channels, 1)
    nn.init.normal_(layer.weight, std=in_channels**-0.5)
    nn.init.zeros_(layer.bias)  # pyright: ignore[reportArgumentType]
    return layer


def activate(x: Tensor) -> Tensor:
    """Apply a leaky ReLU in place, so that x is not kept for the backward pass."""
    return nn.functional.leaky_relu_(x, SLOPE)


def per_pixel(layer: nn.Conv2d, x: Float[Tensor, "*s c"]) -> Float[Tensor, "*s d"]:
    """Apply a `projection` to a tensor whose last axis is the channels."""
    return nn.functional.linear(x, layer.weight[:, :, 0, 0], layer.bias)


class ConvBlock(nn.Module):
    """Two 3x3 convolutions, each followed by a leaky ReLU; the first may halve the resolution."""

    def __init__(self, in_channels: int, out_channels: int, stride: int = 1) -> None:
        super().__init__()
        self.first = conv(in_channels, out_channels, stride=stride)
        self.second = conv(out_channels, out_channels)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h2 w2"]:
        """Return features of the block's output channels."""
        return activate(self.second(activate(self.first(x))))


class Upsample(nn.Module):
    """Nearest-neighbour doubling and a 3x3 convolution, folded into one 4x4 transposed convolution.

    The 4x4 kernel holds four 2x2 kernels, one per output parity; it is learnt directly, which
    contains every folded 3x3 kernel and costs less than half as much.
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv = nn.ConvTranspose2d(in_channels, out_channels, 4, stride=2, padding=1)
        # Each output pixel sums four taps, whatever the kernel's size.
        nn.init.normal_(self.conv.weight, std=(2 / (1 + SLOPE**2) / (4 * in_channels)) ** 0.5)
        nn.init.zeros_(self.conv.bias)  # pyright: ignore[reportArgumentType]

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h2 w2"]:
        """Return features at twice the resolution."""
        return activate(self.conv(x))


def channels_last(x: Tensor) -> Tensor:
    """Lay a [b, c, h, w] tensor out pixel by pixel, which oneDNN's CPU convolutions prefer."""
    return x.contiguous(memory_format=torch.channels_last)
