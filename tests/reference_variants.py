"""`dsar.network.reference` extended by what the paper does not have, or only in ablations, as slowly."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, pixel_shuffle, pixel_unshuffle

from dsar.network import DualStreamNetwork, NetworkOutput
from dsar.network.model import OFFSET_UNIT
from dsar.network.reference import (
    ReferenceNetwork,
    ReferenceRollout,
    attend,
    convolve,
    convolve_twice,
    doubling_kernels,
    fold_doubling,
    repeat,
)


class ReferenceVariant(ReferenceNetwork):
    """Other wirings, readouts and banks, several offsets or none, no motion embedding, cells of pixels."""

    def forward(self, maps, magnitudes, offsets, memory):
        """Take `offsets` as each frame of the window is given them [b n 3k h w]."""
        return self.predict(self.concatenate(maps, offsets), magnitudes, memory)

    def predict(self, inputs, magnitudes, memory):
        net = self.network
        features = self.encode(inputs)
        enhanced = features[-1]
        if net.motion_embedding is not None:
            enhanced = enhanced + self.embed_motion(magnitudes, tuple(enhanced.shape[-2:]))
        aggregate = self.attend_window(enhanced + net.attention.position_embedding[:, :, None, None])
        if net.config.memory == 0:
            hidden = aggregate
        elif net.config.bank == "hidden":
            hidden, memory = self.remember(aggregate, memory)
        else:
            hidden, memory = self.remember_features(aggregate, enhanced[:, -1], memory)
        return self.decode(self.aggregate_levels(features, hidden)), memory

    def concatenate(self, maps, offsets):
        fine, uv_features = self.network.config.pixel_shuffle, self.network.encoder.uv_features
        parts = [pixel_unshuffle(maps, fine), pixel_unshuffle(offsets / OFFSET_UNIT, fine)]
        if uv_features is not None:
            parts.append(uv_features[None].expand(*maps.shape[:2], -1, -1, -1))
        return torch.cat(parts, 2)

    def encode(self, inputs):
        encoder = self.network.encoder
        if self.network.config.wiring != "late":
            return super().encode(inputs)
        channels = (encoder.map_channels, encoder.offset_channels)
        maps, offsets, uv_features = inputs.split([*channels, inputs.shape[2] - sum(channels)], 2)
        features = super().encode(torch.cat([maps, uv_features], 2))
        if encoder.offset_pyramid is None:
            return features
        # All frames are given the same.
        x = convolve(encoder.offset_pyramid.first, offsets[:, -1])
        thin = [convolve(encoder.offset_pyramid.second, x)]
        for block in encoder.offset_pyramid.deeper:
            thin.append(convolve_twice(block, thin[-1]))
        widened = [conv2d(x, widen.weight, widen.bias) for widen, x in zip(encoder.widen, thin, strict=True)]
        return [f + x[:, None] for f, x in zip(features, widened, strict=True)]

    def attend_window(self, tokens):
        config = self.network.config
        if config.readout == "last":
            return self.attend_causally(tokens)
        mask = 0.0
        if config.causal:
            mask = tokens.new_full((config.window, config.window), -torch.inf).triu(1)
        return attend(self.network.attention, tokens, tokens, mask).mean(1)

    def remember_features(self, aggregate, features, memory):
        bank = self.network.bank
        entries = repeat(features, self.network.config.memory) if memory is None else memory
        keys_values = entries + bank.attention.position_embedding[:, :, None, None]
        retrieved = attend(bank.attention, aggregate[:, None], keys_values)[:, 0]
        weight = torch.sigmoid(bank.memory_logit)
        hidden = (1 - weight) * aggregate + weight * retrieved
        return hidden, torch.cat([entries[:, 1:], features[:, None]], 1)

    def upsample(self, hierarchy):
        return pixel_shuffle(super().upsample(hierarchy), self.network.config.pixel_shuffle)


class VariantRollout(ReferenceRollout):
    """Carries as many offsets as the wiring and the feedback ask for."""

    def __init__(self, network: ReferenceVariant) -> None:
        super().__init__(network)
        self.frames: list[tuple[Tensor, Tensor]] = []
        self.offsets: list[Tensor] = []

    def step(self, maps: Tensor, magnitude: Tensor) -> NetworkOutput:
        """Advance by one frame."""
        config, now = self.network.network.config, len(self.frames)
        self.frames.append((maps, magnitude))
        # Before the first frame the body stood still in it.
        window = [max(0, frame) for frame in range(now - config.window + 1, now + 1)]
        window_maps, magnitudes = (
            torch.stack(x, 1) for x in zip(*[self.frames[i] for i in window], strict=True)
        )
        given = [self.offsets_before(i if config.wiring == "perframe" else now) for i in window]
        output, self.memory = self.network(window_maps, magnitudes, torch.stack(given, 1), self.memory)
        self.offsets.append(output.offset)
        return output

    def offsets_before(self, frame: int) -> Tensor:
        zero = torch.zeros_like(self.frames[0][0][:, :3])
        feedback = self.network.network.config.feedback
        before = [self.offsets[i] if i >= 0 else zero for i in range(frame - feedback, frame)]
        return torch.cat(before, 1) if before else zero[:, :0]


def fold_kernels(network: DualStreamNetwork) -> Sequence[nn.Parameter]:
    """Draw the reference's doubling kernels, and give the network's decoder their folded form."""
    kernels = doubling_kernels(network)
    for up, kernel in zip(network.decoder.ups, kernels, strict=True):
        up.conv.weight.data = fold_doubling(kernel)
    return kernels
