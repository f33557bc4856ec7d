"""The network of the paper's section 3: one step of the autoregression for a batch of rollouts."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from dsar.config import ModelConfig
from dsar.network.decoder import Decoder
from dsar.network.layers import ConvBlock, channels_last
from dsar.network.state import NetworkState
from dsar.network.temporal import MemoryBank, MotionEmbedding, TemporalAttention, TemporalMixing

OFFSET_UNIT = 0.1
"""Metres of offset that the geometric stream presents to the encoder as 1."""


@dataclass(frozen=True)
class NetworkOutput:
    """One step's residual maps, and the features that the temporal losses compare."""

    offset: Float[Tensor, "b 3 h w"]
    """Displacement of the Gaussians at rest along the configured axes, metres."""
    appearance: Float[Tensor, "b a h w"]
    """Residuals of raw values: quaternion 4, log-scale 3, opacity logit 1, harmonics 3k."""
    features: tuple[Float[Tensor, "b _ _ _"], ...]
    """The aggregated hierarchy F, finest level first."""

    def select(self, rollouts: Sequence[int]) -> "NetworkOutput":
        """Return the output of some rollouts of the batch."""
        index = list(rollouts)
        features = tuple(feature[index] for feature in self.features)
        return NetworkOutput(self.offset[index], self.appearance[index], features)


class DualStreamNetwork(nn.Module):
    """Encoder, temporal aggregation, memory bank and decoder around the two recurrent streams.

    Wiring `shared` is the paper's: the previous offset is concatenated to every frame of the window,
    so all n frames are encoded anew at each step. `perframe` gives frame tau the offset that preceded
    it, so a frame's encoding never changes and each is computed once.
    """

    def __init__(self, config: ModelConfig, occupied: Bool[Tensor, "h w"]) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("occupied", occupied[None, None].float())
        self.occupied: Tensor
        channels = config.channels
        deepest = channels[-1]
        self.identity = nn.Parameter(0.1 * torch.randn(1, config.identity_channels, *occupied.shape))
        inputs = config.map_channels + config.identity_channels + 3 * config.feedback
        strides = [1, *[2] * (len(channels) - 1)]
        self.encoder = nn.ModuleList(
            ConvBlock(a, b, s) for a, b, s in zip([inputs, *channels], channels, strides, strict=False)
        )
        self.motion_embedding = MotionEmbedding(deepest) if config.motion_embedding else None
        self.attention = TemporalAttention(deepest, config.heads, config.window)
        self.bank = MemoryBank(deepest, config.heads, config.memory, config.recall) if config.memory else None
        self.mixing = nn.ModuleList(TemporalMixing(c, config.window) for c in channels[:-1])
        self.decoder = Decoder(channels, 3 + config.appearance_channels)

    def hidden_weights(self) -> list[nn.Parameter]:
        """Return the convolutions' weights between the inputs and the head."""
        others = (self.identity, self.decoder.head.weight)
        return [p for p in self.parameters() if p.ndim == 4 and not any(p is other for other in others)]

    def start(self, batch: int) -> NetworkState:
        """Return the state of rollouts that have seen nothing yet."""
        c, (h, w) = self.config, self.occupied.shape[2:]
        deepest = len(c.channels) - 1
        coarse = (-(-h // 2**deepest), -(-w // 2**deepest))
        zeros = self.occupied.new_zeros
        if c.wiring == "shared":
            window = (zeros(batch, c.window, c.map_channels, h, w),)
        else:
            sizes = [(-(-h // 2**level), -(-w // 2**level)) for level in range(deepest + 1)]
            window = tuple(
                zeros(batch, c.window, k, *size) for k, size in zip(c.channels, sizes, strict=True)
            )
        return NetworkState(
            fresh=torch.ones(batch, dtype=torch.bool, device=self.occupied.device),
            window=window,
            motion=zeros(batch, c.window * c.motion_embedding, c.channels[-1], *coarse),
            offset=zeros(batch, 3, h, w),
            memory=zeros(batch, c.memory, c.channels[-1], *coarse),
        )

    def forward(
        self,
        maps: Float[Tensor, "b c h w"],
        magnitude: Float[Tensor, "b 1 h w"],
        state: NetworkState,
        *,
        streams: bool = True,
    ) -> tuple[NetworkOutput, NetworkState]:
        """Advance every rollout by one frame.

        `maps` are the standardised position, velocity (and acceleration) maps of the newest frame,
        `magnitude` its standardised motion magnitude V. With `streams` off the previous offset is
        zero and the bank holds the current aggregate only (stage 1 of the paper).
        """
        feedback = state.offset / OFFSET_UNIT if streams else torch.zeros_like(state.offset)
        frames, window = self._encode_window(maps, feedback, state)
        deep, motion = frames[-1], state.motion
        if self.motion_embedding is not None:
            coarse = nn.functional.adaptive_avg_pool2d(magnitude, (deep.shape[-2], deep.shape[-1]))
            motion = push(motion, self.motion_embedding(coarse), state.fresh)
            deep = deep + motion
        aggregate = self.attention(deep[:, -1], deep)
        hidden, memory = aggregate, state.memory
        if self.bank is not None:
            recalled = repeat_where(state.fresh, aggregate, memory)
            if not streams:
                recalled = aggregate[:, None].expand_as(memory)
            hidden = self.bank(aggregate, recalled)
            memory = push(recalled, hidden, state.fresh)

        features = [mix(f) for mix, f in zip(self.mixing, frames[:-1], strict=True)] + [hidden]
        raw = self.decoder(features)
        offset = self._bounded(raw[:, :3]) * self.occupied
        next_state = NetworkState(
            fresh=torch.zeros_like(state.fresh),
            window=window,
            motion=motion,
            offset=offset,
            memory=memory,
        )
        appearance = self.config.appearance_scale * raw[:, 3:]
        return NetworkOutput(offset, appearance, tuple(features)), next_state

    def _bounded(self, raw: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
        """Scale raw offsets to metres; a loose tanh guards long rollouts and costs nothing inside it."""
        limit = self.config.offset_limit
        return limit * torch.tanh(raw * (self.config.offset_scale / limit))

    def _encode_window(
        self, maps: Tensor, feedback: Tensor, state: NetworkState
    ) -> tuple[list[Float[Tensor, "b n _ _ _"]], tuple[Tensor, ...]]:
        """Return per-level encodings of the window, oldest frame first, and the window to keep."""
        if self.config.wiring == "perframe":
            encoded = self._encode(maps, feedback)
            frames = [push(old, new, state.fresh) for old, new in zip(state.window, encoded, strict=True)]
            return frames, tuple(frames)
        inputs = push(state.window[0], maps, state.fresh)
        n = inputs.shape[1]
        encoded = self._encode(inputs.flatten(0, 1), feedback.repeat_interleave(n, 0))
        return [f.reshape(-1, n, *f.shape[1:]) for f in encoded], (inputs,)

    def _encode(self, maps: Tensor, feedback: Tensor) -> list[Float[Tensor, "b _ _ _"]]:
        """Return the feature pyramid of frames, finest level first (paper equations 4-5)."""
        parts = [maps, self.identity.expand(len(maps), -1, -1, -1)]
        if self.config.feedback:
            parts.append(feedback)
        x = channels_last(torch.cat(parts, 1))
        features = []
        for block in self.encoder:
            x = block(x)
            features.append(x)
        return features


def repeat_where(
    fresh: Bool[Tensor, " b"], newest: Float[Tensor, "b *s"], ring: Float[Tensor, "b n *s"]
) -> Float[Tensor, "b n *s"]:
    """Return the ring, or copies of the newest entry for rollouts that have no history yet."""
    if not fresh.any():
        return ring
    mask = fresh.reshape(-1, *[1] * (ring.ndim - 1))
    return torch.where(mask, newest[:, None], ring)


def push(
    ring: Float[Tensor, "b n *s"], newest: Float[Tensor, "b *s"], fresh: Bool[Tensor, " b"]
) -> Float[Tensor, "b n *s"]:
    """Drop the oldest entry of a ring and append the newest; without history it fills the ring."""
    history = repeat_where(fresh, newest, ring)
    return torch.cat([history[:, 1:], newest[:, None]], 1)
