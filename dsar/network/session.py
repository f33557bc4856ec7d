"""Inference without gradients: the steps of `DualStreamNetwork.forward`, but computing only what is new.

What depends on one frame alone is computed once, when the frame arrives, and cached: its features (where the
wiring lets them be), its embedded motion, its key and value, and those of its hidden state. The caches are
rings that are overwritten in place. What depends on weights and positions alone is computed at the start, for
every place that the newest frame can have in a ring.
"""

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from dsar.network.encoder import WindowFeatures
from dsar.network.frozen import frozen_copy
from dsar.network.memory import MemoryBank
from dsar.network.model import DualStreamNetwork, NetworkOutput
from dsar.network.positions import PositionTable
from dsar.network.ring import RingBuffer, RingIndex
from dsar.network.state import STREAMS, Stream

_WARMUP_STEPS = 3
"""Steps on a GPU before one is recorded: they allocate the rings and choose the convolutions' algorithms."""


@dataclass(frozen=True)
class SessionSnapshot:
    """What an inference session knew after a step: copies, which later steps do not touch."""

    offsets: Float[Tensor, "b k 3 h w"] | None
    """The last k offsets, metres; None before the first frame."""
    newest: tuple[Int64[Tensor, "1"], ...]
    """Which entries of the window's rings and of the bank's are the newest."""
    rings: tuple[Tensor | None, ...]
    """Entries of all rings; None of those that nothing was written to."""


class InferenceSession:
    """A batch of rollouts from their first frame on, of a network with the weights that it had then.

    After `restore` the next steps are, byte for byte, those that followed the `snapshot`.
    """

    @torch.inference_mode()
    def __init__(
        self,
        network: DualStreamNetwork,
        streams: Collection[Stream] = STREAMS,
        precision: torch.dtype | None = None,
    ) -> None:
        """Start rollouts; in 16-bit numbers (bfloat16), if that is the precision."""
        network = frozen_copy(network, precision)
        self.network, self.streams = network, streams
        config, device = network.config, network.occupied.device
        self._static_term = network.encoder.static_term()
        # Where features never change, keys and values do not either, and the newest row needs no others.
        cacheable, all_rows = network.encoder.features_cacheable, network.readout.reads_all_rows
        self._features_cacheable = cacheable
        levels = len(network.encoder.cached_channels()) - (cacheable and not all_rows)
        self._index = RingIndex(config.window, device)
        self._frames = [RingBuffer(self._index) for _ in range(levels)]
        self._motion = RingBuffer(self._index)
        self._key_values = RingBuffer(self._index)
        self._positions = network.position_table(self._index.positions_by_index())
        self._bank_index = RingIndex(config.memory, device)
        self._bank = RingBuffer(self._bank_index)
        if network.bank is not None:
            positions = self._bank_index.positions_by_index()
            self._bank_position_bias = network.bank.attention.position_bias(positions)
        self._rings = (*self._frames, self._motion, self._key_values, self._bank)
        self._offsets: Tensor | None = None
        self._started = False
        self._eager_steps = 0
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
        # The first frame fills the rings, which no recorded step does.
        if maps.device.type == "cpu" or not self._started or self._eager_steps < _WARMUP_STEPS:
            self._eager_steps += 1
            return self._compute_step(maps, magnitude)
        if self._graph is None or self._inputs is None:
            self._inputs, self._graph = (maps.clone(), magnitude.clone()), torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph):
                self._output = self._compute_step(*self._inputs)
        self._inputs[0].copy_(maps)
        self._inputs[1].copy_(magnitude)
        self._graph.replay()
        assert self._output is not None
        return self._output

    @torch.inference_mode()
    def snapshot(self) -> SessionSnapshot:
        """Return what is known after the last step, for `restore`."""
        return SessionSnapshot(
            offsets=self._offsets.clone() if self._started and self._offsets is not None else None,
            newest=(self._index.newest.clone(), self._bank_index.newest.clone()),
            rings=tuple(ring.snapshot() for ring in self._rings),
        )

    @torch.inference_mode()
    def restore(self, snapshot: SessionSnapshot) -> None:
        """Go back, or on, to where a session of the same weights and batch was.

        Tensors are copied into those that are there, which a recorded step reads and writes.
        """
        self._started = snapshot.offsets is not None
        if snapshot.offsets is None:
            self._offsets = None if self._offsets is None else self._offsets.zero_()
        elif self._offsets is None:
            self._offsets = snapshot.offsets.to(self._index.newest.device, copy=True)
        else:
            self._offsets.copy_(snapshot.offsets)
        for index, newest in zip((self._index, self._bank_index), snapshot.newest, strict=True):
            index.newest.copy_(newest)
        for ring, entries in zip(self._rings, snapshot.rings, strict=True):
            ring.restore(entries)

    def _compute_step(self, maps: Tensor, magnitude: Tensor) -> NetworkOutput:
        network = self.network
        if self._offsets is None:
            self._offsets = maps.new_zeros(len(maps), network.config.feedback, 3, *maps.shape[2:])
        self._started = True
        self._index.advance()
        maps, magnitude = maps.to(network.occupied.dtype), magnitude.to(network.occupied.dtype)
        offsets = network.offset_input(self._offsets, self.streams)
        frame = network.encoder.encode_frame(network.unshuffle(maps), offsets, self._static_term)
        precomputed = network.encoder.precompute(frame, self._static_term)
        motion = network.embed_motion(magnitude) if network.motion_embedding is not None else None
        positions = self._positions.select(self._index.newest)
        attend = self._attend_cached if self._features_cacheable else self._attend_recomputed
        window, aggregate, newest = attend(precomputed, motion, offsets, positions)
        features = window.add_offset_features(newest)
        hidden = aggregate
        if network.bank is not None:
            hidden = self._retrieve(network.bank, aggregate, features)
            self._update_bank(network.bank, hidden, features)
        output = network.decode(window, hidden, positions)
        for older, newer in itertools.pairwise([*self._offsets.unbind(1), output.offset]):
            older.copy_(newer)
        return output

    def _attend_cached(
        self, precomputed: Sequence[Tensor], motion: Tensor | None, offsets: Tensor, positions: PositionTable
    ) -> tuple[WindowFeatures, Tensor, Tensor]:
        """Return the window, A and f + m of the newest frame, where older frames' features are cached."""
        network = self.network
        deep = precomputed[-1] if motion is None else precomputed[-1] + motion
        levels = [*precomputed[:-1], deep]
        frames = [ring.push_map(level) for ring, level in zip(self._frames, levels, strict=False)]
        if not network.readout.reads_all_rows:
            frames.append(deep[:, None])
        window = network.encoder.assemble_window(frames, offsets)
        key_values = self._key_values.push(network.attention.project_keys_values(deep[:, None])[:, 0])
        return window, network.aggregate(frames[-1], key_values, window, positions), deep

    def _attend_recomputed(
        self, precomputed: Sequence[Tensor], motion: Tensor | None, offsets: Tensor, positions: PositionTable
    ) -> tuple[WindowFeatures, Tensor, Tensor]:
        """Return the same where the features of all frames change at every step."""
        network = self.network
        frames = [ring.push_map(level) for ring, level in zip(self._frames, precomputed, strict=True)]
        window = network.encoder.assemble_window(frames, offsets)
        deep = window.frames[-1]
        if motion is not None:
            deep = window.motion_enhanced(self._motion.push_map(motion))
        newest = deep.index_select(1, self._index.newest)
        queries = deep if network.readout.reads_all_rows else newest
        key_values = network.attention.project_keys_values(deep)
        return window, network.aggregate(queries, key_values, window, positions), newest[:, 0]

    def _retrieve(self, bank: MemoryBank, aggregate: Tensor, features: Tensor) -> Tensor:
        """Return the hidden state h of the newest frame, from what the bank holds of the past."""
        key_values = self._bank.entries
        if key_values is None or "state" not in self.streams:
            first = bank.first_entry(aggregate, features)
            memory = first[:, None].expand(-1, self._bank_index.length, -1, -1, -1)
            key_values = bank.attention.project_keys_values(memory)
        position_bias = self._bank_position_bias.index_select(0, self._bank_index.newest)[0]
        return bank(aggregate, key_values, position_bias)

    def _update_bank(self, bank: MemoryBank, hidden: Tensor, features: Tensor) -> None:
        """Put the newest frame's entry into the bank, as the key and value that later frames will ask for."""
        self._bank_index.advance()
        entry = bank.entry(hidden, features)
        self._bank.push(bank.attention.project_keys_values(entry[:, None])[:, 0])
