"""The network of the paper's section 3: one step of the autoregression for a batch of rollouts."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from dsar.config import ModelConfig
from dsar.network.decoder import Decoder, LinearBases
from dsar.network.encoder import OFFSET_WIRINGS, WindowFeatures
from dsar.network.state import NetworkState, fill_where_fresh, push
from dsar.network.temporal import MemoryBank, MotionEmbedding, TemporalAggregation, TemporalAttention

OFFSET_UNIT = 0.1
"""Metres of offset that the geometric stream presents to the encoder as 1."""
Stream = Literal["geometric", "state"]
STREAMS: tuple[Stream, ...] = ("geometric", "state")
"""Both: previous offsets fed back, and the memory bank."""


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


@dataclass(frozen=True)
class PositionTable:
    """What depends on where in the window the frames of each age are."""

    table: Float[Tensor, "*p n _"]
    """Side by side: what each frame's age adds to its key and value, and its weights in the aggregates of
    shallow levels, finest first."""
    widths: tuple[int, ...]
    """Their channels."""
    positions: Int64[Tensor, "*p n"] | None
    """Each frame's age, 0 the oldest, where all of them ask and not the newest alone."""

    @classmethod
    def build(cls, network: "DualStreamNetwork", order: Int64[Tensor, "*p n"]) -> "PositionTable":
        """Return those of frames in an order, or in each of several."""
        weights = (mix.get_parameter("weights")[order] for mix in network.aggregation)
        columns = [network.attention.position_bias(order), *weights]
        widths = tuple(column.shape[-1] for column in columns)
        return cls(torch.cat(columns, -1), widths, order if network.config.readout == "mean" else None)

    def select(self, index: Int64[Tensor, "1"]) -> "PositionTable":
        """Return those of one of several orders."""
        order = None if self.positions is None else self.positions.index_select(0, index)[0]
        return PositionTable(self.table.index_select(0, index)[0], self.widths, order)

    def columns(self) -> tuple[Float[Tensor, "*p n _"], ...]:
        """Return the parts of the table."""
        return self.table.split(self.widths, -1)


class DualStreamNetwork(nn.Module):
    """Encoder, temporal aggregation, memory bank and decoder around the two recurrent streams.

    `forward` is one step of training. A rollout that needs no gradients goes through
    `dsar.network.session`, which takes the same steps and keeps what does not change.
    """

    def __init__(self, config: ModelConfig, occupied: Bool[Tensor, "h w"]) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("occupied", occupied[None, None].float())
        self.occupied: Tensor
        channels, deepest, fine = config.channels, config.channels[-1], config.pixel_shuffle
        self.grid = (occupied.shape[0] // fine, occupied.shape[1] // fine)
        self.encoder = OFFSET_WIRINGS[config.wiring](config, self.grid)
        self.motion_embedding = MotionEmbedding(deepest) if config.motion_embedding else None
        self.attention = TemporalAttention(deepest, config.heads, config.window)
        self.bank = (
            MemoryBank(deepest, config.heads, config.memory, config.memory_weight) if config.memory else None
        )
        self.aggregation = nn.ModuleList(TemporalAggregation(c, config.window) for c in channels[:-1])
        outputs, coarse = fine**2 * (3 + config.appearance_channels), self.level_size(len(channels) - 1)
        self.decoder = (
            LinearBases(deepest * coarse[0] * coarse[1], outputs, self.grid, config.bases)
            if config.bases
            else Decoder(channels, outputs)
        )

    def hidden_weights(self) -> list[nn.Parameter]:
        """Return the convolutions' weights between the inputs and the head."""
        others = (self.encoder.uv_features, self.decoder.head.weight)
        return [p for p in self.parameters() if p.ndim == 4 and not any(p is other for other in others)]

    def level_size(self, level: int) -> tuple[int, int]:
        """Return height and width of a level of the hierarchy, 0 the finest."""
        return -(-self.grid[0] // 2**level), -(-self.grid[1] // 2**level)

    def initial_state(self, batch: int) -> NetworkState:
        """Return the state of rollouts that have seen nothing yet."""
        c, zeros, deepest = self.config, self.occupied.new_zeros, len(self.config.channels) - 1

        def ring(length: int, channels: int, level: int) -> Tensor:
            return zeros(batch, length, *self.level_size(level), channels).movedim(-1, 2)

        kept = enumerate(self.encoder.cached_channels())
        return NetworkState(
            fresh=torch.ones(batch, dtype=torch.bool, device=self.occupied.device),
            window=tuple(ring(c.window, count, level) for level, count in kept),
            motion=ring(c.window * c.motion_embedding, c.channels[-1], deepest),
            offsets=zeros(batch, c.feedback, 3, *self.occupied.shape[2:]),
            memory=ring(c.memory, c.channels[-1], deepest),
        )

    def forward(
        self,
        maps: Float[Tensor, "b c h w"],
        magnitude: Float[Tensor, "b 1 h w"],
        state: NetworkState,
        *,
        streams: Collection[Stream] = STREAMS,
    ) -> tuple[NetworkOutput, NetworkState]:
        """Advance every rollout by one frame.

        `maps` are the standardised position, velocity (and acceleration) maps of the newest frame,
        `magnitude` its standardised motion magnitude V. Without the stream `geometric` previous offsets
        count as zero, without `state` the bank holds the current aggregate only (stage 1 of the paper).
        """
        offsets = self.offset_input(state.offsets, streams)
        static = self.encoder.static_term()
        kept = self.encoder.encode_frame(self.unshuffle(maps), offsets, static)
        rings = [push(old, new, state.fresh) for old, new in zip(state.window, kept, strict=True)]
        precomputed = self.encoder.precompute([ring.flatten(0, 1) for ring in rings], static)
        frames = [each.unflatten(0, rings[0].shape[:2]) for each in precomputed]
        window, motion = self.encoder.assemble_window(frames, offsets), state.motion
        deep = window.frames[-1]
        if self.motion_embedding is not None:
            motion = push(motion, self.embed_motion(magnitude), state.fresh)
            deep = deep + motion
        queries = deep if self.config.readout == "mean" else deep[:, -1:]
        positions = PositionTable.build(self, torch.arange(self.config.window, device=deep.device))
        aggregate = self.aggregate(queries, self.attention.project_keys_values(deep), window, positions)
        hidden, memory = aggregate, state.memory
        if self.bank is not None:
            newest = (
                deep[:, -1] if window.offset_features is None else deep[:, -1] + window.offset_features[-1]
            )
            first = aggregate if self.config.bank == "hidden" else newest
            recalled = fill_where_fresh(state.fresh, first, memory)
            if "state" not in streams:
                recalled = first[:, None].expand_as(memory)
            attention = self.bank.attention
            hidden = self.bank(aggregate, attention.project_keys_values(recalled), attention.position_bias())
            memory = push(recalled, hidden if self.config.bank == "hidden" else newest, state.fresh)
        output = self.decode(window, hidden, positions)
        next_state = NetworkState(
            fresh=torch.zeros_like(state.fresh),
            window=tuple(rings),
            motion=motion,
            offsets=torch.cat([state.offsets, output.offset[:, None]], 1)[:, 1:],
            memory=memory,
        )
        return output, next_state

    def unshuffle(self, maps: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h2 w2"]:
        """Move the pixels of each of the network's cells into channels."""
        fine = self.config.pixel_shuffle
        return maps if fine == 1 else nn.functional.pixel_unshuffle(maps, fine)

    def offset_input(
        self, offsets: Float[Tensor, "b k 3 h w"], streams: Collection[Stream]
    ) -> Float[Tensor, "b o h2 w2"]:
        """Return the encoder's input of previous offsets, newest last; zero without the geometric stream."""
        scaled = self.unshuffle(offsets.flatten(1, 2) / OFFSET_UNIT).to(self.occupied.dtype)
        return scaled if "geometric" in streams else torch.zeros_like(scaled)

    def embed_motion(self, magnitude: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b c h2 w2"]:
        """Return the embedding of a motion magnitude at the deepest level."""
        assert self.motion_embedding is not None
        coarse = self.level_size(len(self.config.channels) - 1)
        return self.motion_embedding(nn.functional.adaptive_avg_pool2d(magnitude, coarse))

    def aggregate(
        self,
        queries: Float[Tensor, "b q c h w"],
        frames: Float[Tensor, "b n h w d"],
        window: WindowFeatures,
        positions: PositionTable,
    ) -> Float[Tensor, "b c h w"]:
        """Return A: what the newest frame finds in the window, or the mean of what every frame finds.

        `queries` is the newest frame, or all of them in the order of `frames`, their keys and values.
        """
        order, position_embedding, future_mask = (
            positions.positions,
            self.attention.position_embedding[-1:],
            None,
        )
        if order is not None:
            position_embedding = self.attention.position_embedding[order]
            future_mask = order[:, None] < order if self.config.causal else None
        offset_features = None if window.offset_features is None else window.offset_features[-1]
        if offset_features is not None:
            queries = queries + offset_features[:, None]
        queries = queries + position_embedding[:, :, None, None]
        attended = self.attention.attend(
            queries, frames, positions.columns()[0], offset_features=offset_features, future_mask=future_mask
        )
        return attended[:, 0] if order is None else attended.mean(1)

    def decode(
        self, window: WindowFeatures, hidden: Float[Tensor, "b c h w"], positions: PositionTable
    ) -> NetworkOutput:
        """Return the residual maps of the newest frame."""
        offset_features = window.offset_features or (None,) * len(window.frames)
        shallow = zip(self.aggregation, window.frames, offset_features, positions.columns()[1:], strict=False)
        features = [
            mix(frames, offset_features, weights) for mix, frames, offset_features, weights in shallow
        ] + [hidden]
        raw = self.decoder(features)
        if self.config.pixel_shuffle > 1:
            raw = nn.functional.pixel_shuffle(raw, self.config.pixel_shuffle)
        limit, appearance = self.config.offset_limit, raw[:, 3 : 3 + self.config.appearance_channels]
        # A loose tanh guards long rollouts and costs nothing inside its limit.
        offset = torch.tanh(raw[:, :3] * (self.config.offset_scale / limit)) * (limit * self.occupied)
        return NetworkOutput(offset, self.config.appearance_scale * appearance, tuple(features))
