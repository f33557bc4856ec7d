"""Two wirings that encode one frame a step: features never change, so a session caches them.

* `PerFrameOffsetEncoder`: a frame is given the offsets that preceded it.
* `LateOffsetEncoder`: frames and the newest offsets have pyramids of their own, whose features are added.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dsar.config import ModelConfig
from dsar.network.encoder import WindowEncoder, WindowFeatures
from dsar.network.layers import activate, projection
from dsar.network.pyramid import Pyramid

_OFFSET_CHANNEL_DIVISOR = 4
"""The offsets' own pyramid in `LateOffsetEncoder` has this many times fewer channels."""


class PerFrameOffsetEncoder(WindowEncoder):
    """A frame is encoded with the offsets that preceded it, once."""

    def encode_frame(self, maps: Tensor, offsets: Tensor, static: Tensor) -> Sequence[Tensor]:
        """Return the frame's features."""
        inputs = torch.cat([maps, offsets], 1)
        return self.pyramid.features(activate(self.pyramid.first_convolution(inputs) + static))


class LateOffsetEncoder(WindowEncoder):
    """Frames are encoded once; the newest offsets have a thin pyramid, whose features every frame shares."""

    pyramid_takes_offsets = False

    def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None:
        super().__init__(config, size)
        thin = [max(1, channels // _OFFSET_CHANNEL_DIVISOR) for channels in config.channels]
        self.offset_pyramid = Pyramid(self.offset_channels, thin) if config.feedback else None
        self.widen = nn.ModuleList(map(projection, thin, config.channels)) if config.feedback else None

    def encode_frame(self, maps: Tensor, offsets: Tensor, static: Tensor) -> Sequence[Tensor]:
        """Return the frame's features."""
        return self.pyramid.features(activate(self.pyramid.first_convolution(maps) + static))

    def assemble_window(self, precomputed: Sequence[Tensor], offsets: Tensor) -> WindowFeatures:
        """Return the frames' features, and those of the newest offsets."""
        pyramid = self.offset_pyramid
        if pyramid is None or self.widen is None:
            return WindowFeatures(tuple(precomputed))
        thin = pyramid.features(activate(pyramid.first_convolution(offsets) + pyramid.static_term(None)))
        widened = (widen(x) for widen, x in zip(self.widen, thin, strict=True))
        return WindowFeatures(tuple(precomputed), tuple(widened))
