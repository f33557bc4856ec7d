"""Input maps and previous offsets to the features of a window: the paper's wiring, and what all share.

A wiring says where the previous deformation, the offset map dmu(t-1), enters, and so what a session can
cache. In the paper's every frame of the window is given the newest offset, and all n are encoded at each
step. The default, `perframe`, is in `variants.offset_wiring`: it encodes the newest frame only.

An encoder works in three steps, so that a session can cache what does not change: `encode_frame` returns the
tensors of the newest frame that are cached, `precompute` what follows from those alone, `assemble_window`
the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from dsar.config import ModelConfig
from dsar.network.layers import SLOPE, activate
from dsar.network.pyramid import Pyramid


@dataclass(frozen=True)
class WindowFeatures:
    """The features of a window of frames: each frame's own, and those that are to be added to all of them."""

    frames: tuple[Float[Tensor, "b _ _ _ _"], ...]
    """By level, finest first; of a level where older frames are not needed, the newest alone."""
    offset_features: tuple[Float[Tensor, "b _ _ _"], ...] | None = None
    """Of the newest offsets, where all frames share them: the layers that follow are linear, so they need not
    be added n times."""

    def motion_enhanced(self, motion: Float[Tensor, "b n c h w"]) -> Float[Tensor, "b n c h w"]:
        """Return f + m of all frames at the coarsest level; attention adds e itself (paper equation 8)."""
        return self.frames[-1] + motion

    def add_offset_features(self, newest: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Return the newest frame's coarsest features with those of the offsets."""
        return newest if self.offset_features is None else newest + self.offset_features[-1]


class WindowEncoder(nn.Module):
    """What all wirings have: a pyramid for the frames, and learned UV features."""

    features_cacheable = True
    """Whether a frame's features never change."""

    pyramid_takes_offsets = True
    """Whether offsets are among a frame's inputs."""

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
        """Return the tensors of a frame that are cached; `offsets` are those before it, newest last."""
        raise NotImplementedError

    def precompute(
        self, frame: Sequence[Float[Tensor, "b _ _ _"]], static: Float[Tensor, "1 d _ _"]
    ) -> Sequence[Float[Tensor, "b _ _ _"]]:
        """Return what can be computed of a frame once and for all, from what it left behind."""
        return frame

    def assemble_window(
        self, precomputed: Sequence[Float[Tensor, "b _ _ _ _"]], offsets: Float[Tensor, "b o h w"]
    ) -> WindowFeatures:
        """Return the window's features from its frames' `precompute`; `offsets` are the newest ones."""
        return WindowFeatures(tuple(precomputed))


class SharedOffsetEncoder(WindowEncoder):
    """The paper's: the newest offset is among the inputs of every frame, I = [p, dp, dmu] (paper equation 4).

    It changes at every step, so all n frames are encoded again; only their share of the first convolution
    can be cached.
    """

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
        sums = precomputed[0]
        if self.offset_channels:
            # A new tensor, which is overwritten, so that not two of n frames are kept.
            first = activate(sums + self.pyramid.first_convolution(offsets, self.map_channels)[:, None])
        else:
            first = leaky_relu(sums, SLOPE)
        features = self.pyramid.features(first.flatten(0, 1))
        return WindowFeatures(tuple(x.unflatten(0, sums.shape[:2]) for x in features))
