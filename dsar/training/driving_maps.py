"""What drives the network in training, made once for every frame: it depends on the motion alone.

An update gathers the frames of its rollouts from a table instead of making their input maps, which costs more
than a tenth of it. Where the table would be too large, frames are made as they are wanted.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.driving import DrivingSignal
from dsar.avatar.mirror import Mirror, mirror_motion
from dsar.body.skinning import blend_transforms
from dsar.devices import send
from dsar.training.rollouts import RolloutCursor

CAPACITY = 1 << 28
"""Bytes that the table may take."""
_BATCH = 64
_FLOAT_BYTES = 4


@dataclass(frozen=True)
class DrivingFrames:
    """What drives the network in one frame of each of several rollouts."""

    maps: Float[Tensor, "b c h w"]
    """Input maps, standardised."""
    magnitude: Float[Tensor, "b 1 h w"]
    """Motion magnitude V, standardised."""
    speed: Float[Tensor, "b 1 h w"]
    """Motion magnitude V, metres per 1/30 s."""
    control_transforms: Float[Tensor, "b p 3 4"]
    """Blend of T_world_rest at the control points."""
    base: Float[Tensor, "b 3 h w"]
    """What the offset starts from, metres: the motion prior's, or zeros."""

    def index_select(self, frames: Int64[Tensor, " k"]) -> "DrivingFrames":
        """Return some of the frames."""
        return DrivingFrames(
            *(getattr(self, f.name).index_select(0, frames) for f in dataclasses.fields(self))
        )


class DrivingMaps:
    """What drives the network in every frame of some sequences, and in their mirror images."""

    def __init__(
        self,
        avatar: Avatar,
        signals: Mapping[str, DrivingSignal],
        *,
        mirrored: bool,
        capacity: int = CAPACITY,
    ) -> None:
        """Make the table, if it fits into `capacity` bytes.

        Args:
            avatar: Whose input maps are meant, its statistics fitted.
            signals: Driving signals of the sequences.
            mirrored: Whether mirror images are wanted, too.
            capacity: 0: frames are always made as they are wanted.
        """
        self._avatar, self._signals, self._mirror = avatar, dict(signals), Mirror(avatar.control)
        self._table: DrivingFrames | None = None
        """All sequences one after another, then all their mirror images."""
        self._starts: dict[str, int] = {}
        self._frames = 0
        for name, signal in self._signals.items():
            self._starts[name] = self._frames
            self._frames += len(signal)
        if self._frames * (1 + mirrored) * frame_bytes(avatar) > capacity:
            return
        windows = torch.cat([signal.windows for signal in self._signals.values()])
        cloth = [signal.cloth for signal in self._signals.values() if signal.cloth is not None]
        parts = []
        for image in range(1 + mirrored):
            for first in range(0, self._frames, _BATCH):
                frames = slice(first, first + _BATCH)
                seen = torch.cat(cloth)[frames] if cloth else None
                which = windows.new_full((len(windows[frames]),), bool(image), dtype=torch.bool)
                parts.append(self._make(windows[frames], seen, which))
        self._table = _joined(parts)

    def gather(self, cursors: Sequence[RolloutCursor]) -> DrivingFrames:
        """Return what drives each rollout where it stands."""
        if self._table is not None:
            rows = [self._starts[c.sequence] + c.frame + self._frames * c.mirrored for c in cursors]
            return self._table.index_select(send(torch.tensor(rows), self._avatar.device))
        windows = torch.stack([self._signals[c.sequence].windows[c.frame] for c in cursors])
        cloth = [self._signals[c.sequence].cloth_at([c.frame]) for c in cursors]
        seen = [frame for frame in cloth if frame is not None]
        mirrored = send(torch.tensor([c.mirrored for c in cursors]), self._avatar.device)
        return self._make(windows, torch.cat(seen) if seen else None, mirrored)

    @torch.no_grad()
    def _make(
        self,
        windows: Float[Tensor, "b t j 4 4"],
        cloth: Float[Tensor, "b g 6"] | None,
        mirrored: Bool[Tensor, " b"],
    ) -> DrivingFrames:
        """Return what drives frames that were filmed, or their mirror images."""
        avatar = self._avatar
        if mirrored.any():
            windows = torch.where(mirrored[:, None, None, None, None], mirror_motion(windows), windows)
            cloth = None if cloth is None else self._mirror.mirror_cloth(cloth, mirrored)
        inputs = avatar.input_maps(windows, avatar.fps, cloth)
        transforms = blend_transforms(avatar.control.weights, windows[:, :1])[:, 0]
        maps, magnitude = avatar.standardize(inputs)
        base = maps.new_zeros(len(maps), 3, *maps.shape[2:]) if cloth is None else avatar.offset_base(cloth)
        return DrivingFrames(maps, magnitude, inputs.magnitude, transforms, base)


def frame_bytes(avatar: Avatar) -> int:
    """Return the bytes of one frame of the table."""
    height, width = avatar.control.size
    numbers = (avatar.model.map_channels + 5) * height * width + 12 * len(avatar.control.cells)
    return _FLOAT_BYTES * numbers


def _joined(parts: Sequence[DrivingFrames]) -> DrivingFrames:
    """Return the frames of all parts, the maps' channels last in memory, as convolutions like them."""
    fields = {
        f.name: torch.cat([getattr(part, f.name) for part in parts])
        for f in dataclasses.fields(DrivingFrames)
    }
    fields["maps"] = fields["maps"].permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)
    return DrivingFrames(**fields)
