"""The network of the paper's section 3.4: one step of the autoregression for a batch of rollouts."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from dsar.config import ModelConfig
from dsar.network.decoder import ResidualDecoder
from dsar.network.encoder import WindowEncoder, WindowFeatures
from dsar.network.memory import MemoryBank
from dsar.network.positions import PositionTable
from dsar.network.pyramid import level_size
from dsar.network.readout import Readout
from dsar.network.state import STREAMS, NetworkState, Stream, fill_where_fresh, push
from dsar.network.temporal import MotionEmbedding, TemporalAggregation, TemporalAttention

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

    def select(self, rollouts: Int64[Tensor, " k"]) -> "NetworkOutput":
        """Return the output of some rollouts of the batch."""
        features = tuple(feature[rollouts] for feature in self.features)
        return NetworkOutput(self.offset[rollouts], self.appearance[rollouts], features)


class DualStreamNetwork(nn.Module):
    """Encoder, temporal aggregation, memory bank and decoder around the two recurrent streams.

    `forward` is one step of training. A rollout that needs no gradients goes through
    `dsar.network.session`, which takes the same steps and keeps what does not change. Both are held to
    `dsar.network.reference`, which reads as the paper does.
    """

    def __init__(
        self,
        config: ModelConfig,
        occupied: Bool[Tensor, "h w"],
        *,
        encoder: WindowEncoder,
        motion_embedding: MotionEmbedding | None,
        attention: TemporalAttention,
        readout: Readout,
        bank: MemoryBank | None,
        aggregation: Iterable[TemporalAggregation],
        decoder: ResidualDecoder,
    ) -> None:
        """Compose a network of its parts (`dsar.network.build_network` makes them).

        `occupied` are the cells of the maps that hold Gaussians. Without a bank there is no state stream.
        """
        super().__init__()
        self.config = config
        self.register_buffer("occupied", occupied[None, None].float())
        self.occupied: Tensor
        self.encoder = encoder
        self.motion_embedding = motion_embedding
        self.attention = attention
        self.readout = readout
        self.bank = bank
        self.aggregation = nn.ModuleList(aggregation)
        self.decoder = decoder
        self.recomputes = False
        """Whether a step's activations are computed again on the way back, instead of kept till then."""

    @property
    def grid(self) -> tuple[int, int]:
        """Height and width of the finest level of the hierarchy."""
        height, width = self.occupied.shape[2:]
        return height // self.config.pixel_shuffle, width // self.config.pixel_shuffle

    def hidden_weights(self) -> list[nn.Parameter]:
        """Return the convolutions' weights between the inputs and the head."""
        others = (self.encoder.uv_features, self.decoder.head.weight)
        return [p for p in self.parameters() if p.ndim == 4 and not any(p is other for other in others)]

    def initial_state(self, batch: int) -> NetworkState:
        """Return the state of rollouts that have seen nothing yet."""
        c, zeros, deepest = self.config, self.occupied.new_zeros, len(self.config.channels) - 1

        def entries(length: int, channels: int, level: int) -> Tensor:
            return zeros(batch, length, *level_size(self.grid, level), channels).movedim(-1, 2)

        cached = enumerate(self.encoder.cached_channels())
        return NetworkState(
            fresh=torch.ones(batch, dtype=torch.bool, device=self.occupied.device),
            window=tuple(entries(c.window, count, level) for level, count in cached),
            motion=entries(c.window * c.motion_embedding, c.channels[-1], deepest),
            offsets=zeros(batch, c.feedback, 3, *self.occupied.shape[2:]),
            memory=entries(c.memory, c.channels[-1], deepest),
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
        if self.recomputes and torch.is_grad_enabled():
            # Nothing here is random, and to keep the generator's state a GPU would be waited for.
            given = maps, magnitude, state, streams
            return checkpoint(self._step, *given, use_reentrant=False, preserve_rng_state=False)
        return self._step(maps, magnitude, state, streams)

    def _step(
        self,
        maps: Float[Tensor, "b c h w"],
        magnitude: Float[Tensor, "b 1 h w"],
        state: NetworkState,
        streams: Collection[Stream],
    ) -> tuple[NetworkOutput, NetworkState]:
        offsets = self.offset_input(state.offsets, streams)
        static = self.encoder.static_term()
        frame = self.encoder.encode_frame(self.unshuffle(maps), offsets, static)
        cached = [push(old, new, state.fresh) for old, new in zip(state.window, frame, strict=True)]
        precomputed = self.encoder.precompute([entries.flatten(0, 1) for entries in cached], static)
        frames = [level.unflatten(0, cached[0].shape[:2]) for level in precomputed]
        window, motion = self.encoder.assemble_window(frames, offsets), state.motion
        deep = window.frames[-1]
        if self.motion_embedding is not None:
            motion = push(motion, self.embed_motion(magnitude), state.fresh)
            deep = window.motion_enhanced(motion)
        queries = deep if self.readout.reads_all_rows else deep[:, -1:]
        positions = self.position_table(torch.arange(self.config.window, device=deep.device))
        aggregate = self.aggregate(queries, self.attention.project_keys_values(deep), window, positions)
        hidden, memory = self._remember(aggregate, window.add_offset_features(deep[:, -1]), state, streams)
        output = self.decode(window, hidden, positions)
        next_state = NetworkState(
            fresh=torch.zeros_like(state.fresh),
            window=tuple(cached),
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
        """Return the embedding of a motion magnitude at the coarsest level."""
        assert self.motion_embedding is not None
        coarse = level_size(self.grid, len(self.config.channels) - 1)
        return self.motion_embedding(nn.functional.adaptive_avg_pool2d(magnitude, coarse))

    def position_table(self, positions: Int64[Tensor, "*p n"]) -> PositionTable:
        """Return what follows from frames' positions in the window, for one order of frames or several."""
        weights = [level.get_parameter("weights") for level in self.aggregation]
        return PositionTable.build(self.attention, weights, positions)

    def aggregate(
        self,
        queries: Float[Tensor, "b q c h w"],
        key_values: Float[Tensor, "b n h w d"],
        window: WindowFeatures,
        positions: PositionTable,
    ) -> Float[Tensor, "b c h w"]:
        """Return A, what the readout makes of the attention over the window.

        `queries` are f + m of the newest frame, or of all in the order of `key_values`.
        """
        offset_features = None if window.offset_features is None else window.offset_features[-1]
        if offset_features is not None:
            queries = queries + offset_features[:, None]
        embedding = self.readout.query_embedding(self.attention.position_embedding, positions.positions)
        rows = self.attention.attend(
            queries + embedding[:, :, None, None],
            key_values,
            positions.key_value_bias,
            offset_features=offset_features,
            future_mask=self.readout.future_mask(positions.positions),
        )
        return self.readout.reduce(rows)

    def _remember(
        self, aggregate: Tensor, features: Tensor, state: NetworkState, streams: Collection[Stream]
    ) -> tuple[Tensor, Tensor]:
        """Return h of the newest frame, whose features these are, and the next step's memory."""
        bank, memory = self.bank, state.memory
        if bank is None:
            return aggregate, memory
        first = bank.first_entry(aggregate, features)
        memory = fill_where_fresh(state.fresh, first, memory)
        if "state" not in streams:
            memory = first[:, None].expand_as(memory)
        key_values = bank.attention.project_keys_values(memory)
        hidden = bank(aggregate, key_values, bank.attention.position_bias())
        return hidden, bank.update(memory, bank.entry(hidden, features), state.fresh)

    def decode(
        self, window: WindowFeatures, hidden: Float[Tensor, "b c h w"], positions: PositionTable
    ) -> NetworkOutput:
        """Return the residual maps of the newest frame."""
        offset_features = window.offset_features or (None,) * len(window.frames)
        weights = positions.aggregation_weights
        shallow = zip(self.aggregation, window.frames, offset_features, weights, strict=False)
        features = [level(*inputs) for level, *inputs in shallow]
        features.append(hidden)
        raw = self.decoder(features)
        if self.config.pixel_shuffle > 1:
            raw = nn.functional.pixel_shuffle(raw, self.config.pixel_shuffle)
        limit, appearance = self.config.offset_limit, raw[:, 3 : 3 + self.config.appearance_channels]
        # A loose tanh guards long rollouts and costs nothing inside its limit.
        offset = torch.tanh(raw[:, :3] * (self.config.offset_scale / limit)) * (limit * self.occupied)
        return NetworkOutput(offset, self.config.appearance_scale * appearance, tuple(features))
