"""Input maps and previous offsets to the features of a window (paper equations 4-5), in three wirings.

They differ in which offsets a frame of the window is given, and so in what it leaves to later steps:

* `SharedOffsetEncoder` (the paper's): every frame is given the newest offsets, so all n are encoded at
  each step.
* `PerFrameOffsetEncoder`: a frame is given the offsets that preceded it, and its features never change.
* `LateOffsetEncoder`: poses and the newest offsets have encoders of their own, whose features are
  added; a pose's never change.

A wiring works in three steps, so that a session can cache what does not change: `encode_frame` says what the
newest frame leaves behind, `precompute` computes what follows from that alone, `assemble_window` the rest.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dsar.config import ModelConfig
from dsar.network.layers import SLOPE, ConvBlock, activate, channels_last, conv, projection

_OFFSET_CHANNEL_DIVISOR = 4
"""The offsets' own encoder in `LateOffsetEncoder` has this many times fewer channels."""


@dataclass(frozen=True)
class WindowFeatures:
    """The features of a window of frames: each frame's own, and what is to be added to all of them."""

    frames: tuple[Float[Tensor, "b _ _ _ _"], ...]
    """By level, finest first; of a level where older frames are not needed, the newest alone."""
    offset_features: tuple[Float[Tensor, "b _ _ _"], ...] | None = None
    """What all frames share: the layers that follow are linear, so it need not be added n times."""


class Pyramid(nn.Module):
    """Convolutions from a frame's inputs to its features, finest level first; every level halves the grid.

    A learnt static map is among the inputs. The first convolution, which is linear, takes it by itself: it is
    the same for every frame and rollout.
    """

    def __init__(self, inputs: int, channels: Sequence[int], static: int = 0) -> None:
        super().__init__()
        self.inputs = inputs
        self.first = conv(inputs + static, channels[0])
        self.second = conv(channels[0], channels[0])
        pairs = itertools.pairwise(channels)
        self.deeper = nn.ModuleList(ConvBlock(shallow, deep, 2) for shallow, deep in pairs)

    def static_term(self, maps: Float[Tensor, "1 s h w"] | None) -> Float[Tensor, "_ c _ _"]:
        """Return what static maps and the bias give to the first convolution, for any frame."""
        bias = self.first.bias[:, None, None]  # pyright: ignore[reportOptionalSubscript]
        if maps is None:
            return bias[None]
        convolved = nn.functional.conv2d(channels_last(maps), self.first.weight[:, self.inputs :], padding=1)
        return channels_last(convolved + bias)

    def first_convolution(self, inputs: Float[Tensor, "b i h w"], start: int = 0) -> Float[Tensor, "b c h w"]:
        """Return what some of the input channels, from number `start` on, give to the first convolution."""
        weight = self.first.weight[:, start : start + inputs.shape[1]]
        return nn.functional.conv2d(channels_last(inputs), weight, padding=1)

    def features(self, first: Float[Tensor, "b c h w"]) -> list[Float[Tensor, "b _ _ _"]]:
        """Return the features from the first convolution's sums."""
        x = nn.functional.leaky_relu(first, SLOPE)
        features = [activate(self.second(x))]
        for block in self.deeper:
            features.append(block(features[-1]))
        return features


class WindowEncoder(nn.Module):
    """What all wirings have: a pyramid for the poses, and the map of UV features."""

    features_cacheable = True
    """Whether a frame's features never change."""

    pyramid_takes_offsets = True
    """Whether offsets are among a pose's inputs."""

    def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None:
        super().__init__()
        cell, self.channels = config.pixel_shuffle**2, config.channels
        self.map_channels, self.offset_channels = cell * config.map_channels, cell * 3 * config.feedback
        inputs = self.map_channels + self.offset_channels * self.pyramid_takes_offsets
        self.pyramid = Pyramid(inputs, config.channels, config.uv_feature_channels)
        uv_features = 0.1 * torch.randn(1, config.uv_feature_channels, *size)
        self.uv_features = nn.Parameter(uv_features) if config.uv_feature_channels else None

    def cached_channels(self) -> Sequence[int]:
        """Return the channels of what a frame leaves behind, by level: its features'."""
        return self.channels

    def static_term(self) -> Float[Tensor, "1 c _ _"]:
        """Return what is the same for all frames; it is an argument of the next two."""
        return self.pyramid.static_term(self.uv_features)

    def encode_frame(
        self,
        maps: Float[Tensor, "b c h w"],
        offsets: Float[Tensor, "b o h w"],
        static: Float[Tensor, "1 d _ _"],
    ) -> Sequence[Float[Tensor, "b _ _ _"]]:
        """Return what a frame leaves behind; `offsets` are those before it, newest last."""
        raise NotImplementedError

    def precompute(
        self, frame: Sequence[Float[Tensor, "b _ _ _"]], static: Float[Tensor, "1 d _ _"]
    ) -> Sequence[Float[Tensor, "b _ _ _"]]:
        """Return what can be computed of a frame once and for all, from what it left behind."""
        return frame

    def assemble_window(
        self, precomputed: Sequence[Float[Tensor, "b _ _ _ _"]], offsets: Float[Tensor, "b o h w"]
    ) -> WindowFeatures:
        """Return the window's features from its frames' `prepare`; `offsets` are the newest ones."""
        return WindowFeatures(tuple(precomputed))


class PerFrameOffsetEncoder(WindowEncoder):
    """A frame is encoded with the offsets that preceded it, once."""

    def encode_frame(self, maps: Tensor, offsets: Tensor, static: Tensor) -> Sequence[Tensor]:
        """Return the frame's features."""
        inputs = torch.cat([maps, offsets], 1)
        return self.pyramid.features(self.pyramid.first_convolution(inputs) + static)


class LateOffsetEncoder(WindowEncoder):
    """Poses are encoded once; the newest offsets have a thin encoder, whose features every frame shares."""

    pyramid_takes_offsets = False

    def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None:
        super().__init__(config, size)
        thin = [max(1, channels // _OFFSET_CHANNEL_DIVISOR) for channels in config.channels]
        self.offset_pyramid = Pyramid(self.offset_channels, thin) if config.feedback else None
        self.widen = nn.ModuleList(map(projection, thin, config.channels)) if config.feedback else None

    def encode_frame(self, maps: Tensor, offsets: Tensor, static: Tensor) -> Sequence[Tensor]:
        """Return the pose's features."""
        return self.pyramid.features(self.pyramid.first_convolution(maps) + static)

    def assemble_window(self, precomputed: Sequence[Tensor], offsets: Tensor) -> WindowFeatures:
        """Return the poses' features, and those of the newest offsets in common."""
        if self.offset_pyramid is None or self.widen is None:
            return WindowFeatures(tuple(precomputed))
        thin = self.offset_pyramid.features(
            self.offset_pyramid.first_convolution(offsets) + self.offset_pyramid.static_term(None)
        )
        return WindowFeatures(
            tuple(precomputed), tuple(widen(x) for widen, x in zip(self.widen, thin, strict=True))
        )


class SharedOffsetEncoder(WindowEncoder):
    """Every frame of the window is encoded with the newest offsets: n encodings a step."""

    features_cacheable = False

    def cached_channels(self) -> Sequence[int]:
        """Return the input maps' channels."""
        return (self.map_channels,)

    def encode_frame(self, maps: Tensor, offsets: Tensor, static: Tensor) -> Sequence[Tensor]:
        """Return the frame's input maps."""
        return (maps,)

    def precompute(self, frame: Sequence[Tensor], static: Tensor) -> Sequence[Tensor]:
        """Return the part of the first convolution that does not see offsets."""
        return (self.pyramid.first_convolution(frame[0]) + static,)

    def assemble_window(self, precomputed: Sequence[Tensor], offsets: Tensor) -> WindowFeatures:
        """Return the features of all frames, encoded with the newest offsets."""
        first = precomputed[0]
        if self.offset_channels:
            first = first + self.pyramid.first_convolution(offsets, self.map_channels)[:, None]
        features = self.pyramid.features(first.flatten(0, 1))
        return WindowFeatures(tuple(x.unflatten(0, first.shape[:2]) for x in features))


OFFSET_WIRINGS: dict[
    str, type[PerFrameOffsetEncoder] | type[LateOffsetEncoder] | type[SharedOffsetEncoder]
] = {
    "shared": SharedOffsetEncoder,
    "late": LateOffsetEncoder,
    "perframe": PerFrameOffsetEncoder,
}
