"""Rollouts without gradients: the steps of `DualStreamNetwork.forward`, but computing only what is new.

Whatever follows from a single frame is computed when it is the newest, and kept: its features (where the
wiring lets them be), its embedded motion, its key and value, and those of its hidden state. What is kept lies
in rings that are overwritten in place, so nothing moves as frames grow older. What follows from weights and
ages alone is computed once, for every place that the newest frame can have in a ring.
"""

import copy
import itertools
from collections.abc import Collection, Sequence

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from dsar.network.encoder import WindowFeatures
from dsar.network.layers import ShuffledUpsample, Upsample, channels_last
from dsar.network.model import STREAMS, DualStreamNetwork, NetworkOutput, PositionTable, Stream
from dsar.network.temporal import TemporalAttention

_WARMUP_STEPS = 3
"""Steps on a GPU before one is recorded: they allocate the rings and choose the convolutions' algorithms."""

_SMALL_GRID = 1024
"""Pixels of a network's finest level up to which `ShuffledUpsample` is faster on a CPU."""

_CHANNEL_MULTIPLE = 16
"""On such levels a matrix product of 14 columns takes half as long again as one of 16."""


class RingIndex:
    """Says which entry of rings of n entries is the newest.

    It is a tensor, so that a recorded step moves it on.
    """

    def __init__(self, length: int, device: torch.device) -> None:
        self.length = length
        self.newest = torch.full((1,), length - 1, dtype=torch.int64, device=device)

    def advance(self) -> None:
        """Go on to the entry that is overwritten next, the oldest."""
        self.newest.add_(1).remainder_(self.length)

    def positions_by_index(self) -> Int64[Tensor, "n n"]:
        """Return, for each place that the newest entry can have, the ages of all: 0 the oldest."""
        positions = torch.arange(self.length, device=self.newest.device)
        return (positions - positions[:, None] - 1) % self.length


class RingBuffer:
    """What the last n frames left, as entries [b n *s]; the first frame's fills it."""

    def __init__(self, index: RingIndex) -> None:
        self._index = index
        self.entries: Tensor | None = None

    def push(self, newest: Float[Tensor, "b *s"]) -> Float[Tensor, "b n *s"]:
        """Write the newest entry; return all."""
        if self.entries is None:
            self.entries = newest[:, None].repeat(1, self._index.length, *[1] * (newest.ndim - 1))
        else:
            self.entries.index_copy_(1, self._index.newest, newest[:, None])
        return self.entries

    def push_map(self, newest: Float[Tensor, "b c h w"]) -> Float[Tensor, "b n c h w"]:
        """Do the same with maps, which lie in memory with their channels last."""
        return self.push(newest.movedim(1, -1)).movedim(-1, 2)


class InferenceSession:
    """A batch of rollouts from their first frame on, of a network as it was then."""

    @torch.inference_mode()
    def __init__(
        self,
        network: DualStreamNetwork,
        streams: Collection[Stream] = STREAMS,
        precision: torch.dtype | None = None,
    ) -> None:
        """Start rollouts; in 16-bit numbers (bfloat16), if that is the precision."""
        network = _frozen_copy(network, precision)
        self.network, self.streams = network, streams
        config, device = network.config, network.occupied.device
        self._static_term = network.encoder.static_term()
        # Where features never change, keys and values do not either, and the newest row needs no others.
        self._features_cacheable = network.encoder.features_cacheable
        index = self._index = RingIndex(config.window, device)
        levels = len(network.encoder.cached_channels()) - (
            self._features_cacheable and config.readout == "last"
        )
        self._frames = [RingBuffer(index) for _ in range(levels)]
        self._motion = RingBuffer(index)
        self._key_values = RingBuffer(index)
        self._positions = PositionTable.build(network, index.positions_by_index())
        if network.bank is not None:
            index = self._bank_index = RingIndex(config.memory, device)
            self._bank = RingBuffer(index)
            self._bank_position_bias = network.bank.attention.position_bias(index.positions_by_index())
        self._offsets: Tensor | None = None
        self._steps = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._inputs: tuple[Tensor, Tensor] | None = None
        self._output: NetworkOutput | None = None

    @torch.inference_mode()
    def step(self, maps: Float[Tensor, "b c h w"], magnitude: Float[Tensor, "b 1 h w"]) -> NetworkOutput:
        """Advance every rollout by one frame; the arguments are those of `DualStreamNetwork.forward`.

        The output is made in inference mode: no gradient can be asked of it, clones excepted.
        On a GPU the first steps are recorded and all later ones replayed as one CUDA graph, which overwrites
        the output of the step before.
        """
        self._steps += 1
        if not maps.is_cuda or self._steps <= _WARMUP_STEPS:
            return self._advance(maps, magnitude)
        if self._graph is None or self._inputs is None:
            self._inputs, self._graph = (maps.clone(), magnitude.clone()), torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph):
                self._output = self._advance(*self._inputs)
        self._inputs[0].copy_(maps)
        self._inputs[1].copy_(magnitude)
        self._graph.replay()
        assert self._output is not None
        return self._output

    def _advance(self, maps: Tensor, magnitude: Tensor) -> NetworkOutput:
        network = self.network
        if self._offsets is None:
            self._offsets = maps.new_zeros(len(maps), network.config.feedback, 3, *maps.shape[2:])
        self._index.advance()
        maps, magnitude = maps.to(network.occupied.dtype), magnitude.to(network.occupied.dtype)
        offsets = network.offset_input(self._offsets, self.streams)
        kept = network.encoder.encode_frame(network.unshuffle(maps), offsets, self._static_term)
        precomputed = network.encoder.precompute(kept, self._static_term)
        motion = network.embed_motion(magnitude) if network.motion_embedding is not None else None
        positions = self._positions.select(self._index.newest)
        attend = self._attend_cached if self._features_cacheable else self._attend_recomputed
        window, aggregate, newest = attend(precomputed, motion, offsets, positions)
        hidden = aggregate if network.bank is None else self._update_bank(aggregate, newest)
        output = network.decode(window, hidden, positions)
        offsets = [*self._offsets.unbind(1), output.offset]
        for older, newer in itertools.pairwise(offsets):
            older.copy_(newer)
        return output

    def _attend_cached(
        self, precomputed: Sequence[Tensor], motion: Tensor | None, offsets: Tensor, positions: PositionTable
    ) -> tuple[WindowFeatures, Tensor, Tensor]:
        """Return the window, its aggregate and the newest deep features."""
        network = self.network
        deep = precomputed[-1] if motion is None else precomputed[-1] + motion
        levels = [*precomputed[:-1], deep]
        frames = [ring.push_map(level) for ring, level in zip(self._frames, levels, strict=False)]
        if network.config.readout == "last":
            frames.append(deep[:, None])
        window = network.encoder.assemble_window(frames, offsets)
        key_values = self._key_values.push(network.attention.project_keys_values(deep[:, None])[:, 0])
        aggregate = network.aggregate(frames[-1], key_values, window, positions)
        return window, aggregate, _add_offset_features(deep, window)

    def _attend_recomputed(
        self, precomputed: Sequence[Tensor], motion: Tensor | None, offsets: Tensor, positions: PositionTable
    ) -> tuple[WindowFeatures, Tensor, Tensor]:
        """Return the same where the features of all frames are needed anew."""
        network = self.network
        rings = [ring.push_map(each) for ring, each in zip(self._frames, precomputed, strict=True)]
        window = network.encoder.assemble_window(rings, offsets)
        deep = window.frames[-1] if motion is None else window.frames[-1] + self._motion.push_map(motion)
        newest = deep.index_select(1, self._index.newest)
        queries = deep if network.config.readout == "mean" else newest
        aggregate = network.aggregate(queries, network.attention.project_keys_values(deep), window, positions)
        return window, aggregate, _add_offset_features(newest[:, 0], window)

    def _update_bank(self, aggregate: Tensor, newest: Tensor) -> Tensor:
        """Return the hidden state of the newest frame, and put it into the bank."""
        bank, config = self.network.bank, self.network.config
        assert bank is not None
        frames = self._bank.entries
        if frames is None or "state" not in self.streams:
            alone = aggregate if config.bank == "hidden" else newest
            frames = bank.attention.project_keys_values(alone[:, None].expand(-1, config.memory, -1, -1, -1))
        ages = self._bank_position_bias.index_select(0, self._bank_index.newest)[0]
        hidden = bank(aggregate, frames, ages)
        self._bank_index.advance()
        entry = hidden if config.bank == "hidden" else newest
        self._bank.push(bank.attention.project_keys_values(entry[:, None])[:, 0])
        return hidden


def _frozen_copy(network: DualStreamNetwork, precision: torch.dtype | None) -> DualStreamNetwork:
    """Return a copy of a network as convolutions without gradients like it best."""
    network = copy.deepcopy(network)
    if network.occupied.device.type == "cpu" and network.grid[0] * network.grid[1] <= _SMALL_GRID:
        ups = [up for up in network.decoder.ups if isinstance(up, Upsample)]
        network.decoder.ups = nn.ModuleList(map(ShuffledUpsample, ups))
        if network.config.pixel_shuffle == 1 and isinstance(network.decoder.head, nn.Conv2d):
            _pad_outputs(network.decoder.head)
    if precision is not None:
        network = network.to(precision)
        network.decoder.head.float()
    for parameter in network.parameters():
        if parameter.ndim == 4:
            parameter.data = channels_last(parameter.data)
    for module in network.modules():
        if isinstance(module, TemporalAttention):
            module.freeze()
    return network


def _pad_outputs(layer: nn.Conv2d) -> None:
    """Add output channels that are zero, up to a multiple of _CHANNEL_MULTIPLE."""
    missing = -layer.out_channels % _CHANNEL_MULTIPLE
    assert layer.bias is not None
    layer.weight.data = nn.functional.pad(layer.weight, (0, 0, 0, 0, 0, 0, 0, missing))
    layer.bias.data = nn.functional.pad(layer.bias, (0, missing))


def _add_offset_features(newest: Tensor, window: WindowFeatures) -> Tensor:
    """Return the newest frame's deepest features with what all frames share."""
    return newest if window.offset_features is None else newest + window.offset_features[-1]
