"""The paper's network as its equations read, nothing saved: tests and timings hold `dsar.network` to it.

Every frame of the window is encoded at every step, all rows of the attention are computed under its causal
mask, keys and values of the bank are projected anew, and maps are doubled before they are convolved. It owns
no parameters but the 3x3 kernels of the decoder's upsampling; those it folds into the given network's.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, leaky_relu, linear

from dsar.network import DualStreamNetwork, NetworkOutput
from dsar.network.encoder import Pyramid
from dsar.network.layers import SLOPE, ConvBlock
from dsar.network.model import OFFSET_UNIT

# Nearest-neighbour doubling and a kernel of 3, as a transposed convolution of 4 and stride 2, along one axis.
FOLD = torch.tensor([[0.0, 0, 1], [0, 1, 1], [1, 1, 0], [1, 0, 0]])


class LiteralNetwork(nn.Module):
    """One step at a time, from the whole history that it depends on."""

    def __init__(self, network: DualStreamNetwork) -> None:
        super().__init__()
        self.network = network
        self.kernels = nn.ParameterList()
        for up in network.decoder.ups:
            deep, shallow = up.conv.weight.shape[:2]
            kernel = torch.randn(shallow, deep, 3, 3).to(up.conv.weight) * (2 / (9 * deep)) ** 0.5
            self.kernels.append(nn.Parameter(kernel))
            fold = FOLD.to(kernel)
            up.conv.weight.data = torch.einsum("ak,oikl,bl->ioab", fold, kernel, fold)

    def forward(
        self,
        maps: Sequence[Tensor],
        magnitudes: Sequence[Tensor],
        offsets: Sequence[Tensor],
        memory: Sequence[Tensor] | None,
    ) -> tuple[NetworkOutput, Tensor]:
        """Return a step's output and what it leaves to the bank, which the first step fills.

        Args:
            maps, magnitudes: Of the window's frames, oldest first.
            offsets: What each of them is given of previous offsets [b 3k h w], metres: in the paper the same.
            memory: What the last m steps left to the bank, oldest first; None at the first step.
        """
        net, config = self.network, self.network.config
        levels = [
            level.chunk(len(maps)) for level in self.encode(torch.cat(list(maps)), torch.cat(list(offsets)))
        ]
        deep = levels[-1]
        if net.motion_embedding is not None:
            size = deep[0].shape[-2:]
            pooled = nn.functional.adaptive_avg_pool2d(torch.cat(list(magnitudes)), size)
            embedded = net.motion_embedding.out(block(net.motion_embedding.block, pooled))
            deep = [f + m for f, m in zip(deep, embedded.chunk(len(maps)), strict=True)]
        tokens = torch.stack(deep, 1) + net.attention.position_embedding[:, :, None, None]
        rows = attend(net.attention, tokens, tokens, causal=config.causal)
        aggregate = rows.mean(1) if config.readout == "mean" else rows[:, -1]
        hidden = aggregate
        left = aggregate if config.bank == "hidden" else deep[-1]
        if net.bank is not None:
            bank = torch.stack(list(memory) if memory else [left] * config.memory, 1)
            bank = bank + net.bank.attention.position_embedding[:, :, None, None]
            recalled = attend(net.bank.attention, aggregate[:, None], bank, causal=False)[:, 0]
            share = torch.sigmoid(net.bank.memory_logit)
            hidden = (1 - share) * aggregate + share * recalled
            left = hidden if config.bank == "hidden" else deep[-1]
        features = []
        for frames, mixing in zip(levels, net.aggregation, strict=False):
            weighted = [f * w[:, None, None] for f, w in zip(frames, mixing.weights, strict=True)]
            features.append(project(mixing.mix, sum(weighted)))
        return self.decode([*features, hidden]), left

    def encode(self, maps: Tensor, offsets: Tensor) -> list[Tensor]:
        """Return the feature pyramids of a batch of frames, finest level first."""
        encoder, fold = self.network.encoder, self.network.config.pixel_shuffle
        maps, offsets = (nn.functional.pixel_unshuffle(x, fold) for x in (maps, offsets / OFFSET_UNIT))
        static = [] if encoder.uv_features is None else [encoder.uv_features.expand(len(maps), -1, -1, -1)]
        if self.network.config.wiring != "late":
            return pyramid(encoder.pyramid, [maps, offsets, *static])
        features = pyramid(encoder.pyramid, [maps, *static])
        if encoder.offset_pyramid is None:
            return features
        thin = pyramid(encoder.offset_pyramid, [offsets])
        return [f + project(w, x) for f, w, x in zip(features, encoder.widen, thin, strict=True)]

    def decode(self, features: Sequence[Tensor]) -> NetworkOutput:
        """Return the residual maps."""
        net, decoder = self.network, self.network.decoder
        x = features[-1]
        for level in reversed(range(len(decoder.ups))):
            x = nn.functional.interpolate(x, scale_factor=2, mode="nearest")
            x = leaky_relu(conv2d(x, self.kernels[level], decoder.ups[level].conv.bias, padding=1), SLOPE)
            x = block(decoder.blocks[level], torch.cat([x, features[level]], 1))
        raw = conv2d(x, decoder.head.weight, decoder.head.bias, padding=1)
        raw = nn.functional.pixel_shuffle(raw, net.config.pixel_shuffle)
        limit = net.config.offset_limit
        offset = limit * torch.tanh(raw[:, :3] * net.config.offset_scale / limit) * net.occupied
        return NetworkOutput(offset, net.config.appearance_scale * raw[:, 3:], tuple(features))


class LiteralRollout:
    """Carries the history of a batch of rollouts from step to step."""

    def __init__(self, literal: LiteralNetwork) -> None:
        self.literal = literal
        self.maps, self.magnitudes, self.made, self.memory = [], [], [], []

    def step(self, maps: Tensor, magnitude: Tensor) -> NetworkOutput:
        """Advance by one frame."""
        config = self.literal.network.config
        self.maps.append(maps)
        self.magnitudes.append(magnitude)
        # Before the first frame the body stood still in it, and nothing was offset.
        ages = range(len(self.maps) - config.window, len(self.maps))
        window = [max(0, i) for i in ages]
        output, left = self.literal(
            [self.maps[i] for i in window],
            [self.magnitudes[i] for i in window],
            [self._offsets_before(i if config.wiring == "perframe" else len(self.maps) - 1) for i in window],
            self.memory or None,
        )
        self.made.append(output.offset)
        for history in (self.maps, self.magnitudes, self.made):
            del history[: -(config.window + config.feedback)]
        self.memory = [*(self.memory or [left] * config.memory), left][-config.memory :]
        return output

    def _offsets_before(self, frame: int) -> Tensor:
        zero = torch.zeros_like(self.maps[0][:, :3])
        feedback = self.literal.network.config.feedback
        before = [self.made[i] if i >= 0 else zero for i in range(frame - feedback, frame)]
        return torch.cat(before, 1) if before else zero[:, :0]


def pyramid(layers: Pyramid, inputs: Sequence[Tensor]) -> list[Tensor]:
    """Return features, finest level first, from inputs concatenated in the order of the weights."""
    x = torch.cat(list(inputs), 1)
    for layer in (layers.first, layers.second):
        x = leaky_relu(conv2d(x, layer.weight, layer.bias, padding=1), SLOPE)
    features = [x]
    for deeper in layers.deeper:
        features.append(block(deeper, features[-1]))
    return features


def block(layers: ConvBlock, x: Tensor) -> Tensor:
    """Return x after two convolutions."""
    for layer in (layers.first, layers.second):
        x = leaky_relu(conv2d(x, layer.weight, layer.bias, stride=layer.stride, padding=1), SLOPE)
    return x


def project(layer: nn.Conv2d, x: Tensor) -> Tensor:
    """Return x after a 1x1 convolution."""
    return conv2d(x, layer.weight, layer.bias)


def attend(layers: nn.Module, queries: Tensor, frames: Tensor, causal: bool) -> Tensor:
    """Return softmax(Q K^T / sqrt(d) + mask) V for every row, pixel and head (equations 9-12)."""
    b, n, c, h, w = frames.shape

    def heads(layer, x):
        x = x.movedim(2, -1).reshape(b, -1, h * w, c)
        x = linear(x, layer.weight[:, :, 0, 0], layer.bias)
        return x.reshape(b, -1, h * w, layers.heads, c // layers.heads).permute(0, 2, 3, 1, 4)

    q, k, v = heads(layers.query, queries), heads(layers.key, frames), heads(layers.value, frames)
    scores = q @ k.mT / (c // layers.heads) ** 0.5
    if causal and queries.shape[1] == n:
        scores = scores.masked_fill(~torch.ones(n, n, dtype=torch.bool, device=q.device).tril(), -torch.inf)
    rows = (scores.softmax(-1) @ v).permute(0, 3, 1, 2, 4).reshape(b, -1, h * w, c)
    rows = linear(rows, layers.out.weight[:, :, 0, 0], layers.out.bias)
    return rows.reshape(b, -1, h, w, c).movedim(-1, 2)
