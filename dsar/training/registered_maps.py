"""The offset maps that registration fits to training frames, and that the network is pre-trained on."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.config import TrainConfig
from dsar.devices import send
from dsar.training import workers
from dsar.training.rollouts import RolloutCursor
from dsar.types import Capture


class RegisteredMaps:
    """A map for each frame of each sequence, as far as they are fitted, and what fitting them took."""

    def __init__(
        self,
        clips: Mapping[str, range],
        points: int,
        unseen: Mapping[str, frozenset[int]],
        device: torch.device | None = None,
    ) -> None:
        """Begin with no map.

        Args:
            clips: Frames to register, by sequence; none where nothing is to be registered.
            points: Number of control points.
            unseen: Frames that no camera saw: their maps carry the cloth on and teach nothing.
            device: Where the maps are; None: in main memory.
        """
        self.clips, self.unseen, self.device = dict(clips), unseen, device or torch.device("cpu")
        self.offsets = {
            name: torch.zeros(clip.stop, points, 3, device=self.device) for name, clip in clips.items()
        }
        """Offsets of the control points along their axes, metres, by frame."""
        self.fitted = {name: torch.zeros((), dtype=torch.int64) for name in clips}
        """Frames of each clip that have a map, counted from its first; in main memory."""
        self._divide(self.clips)

    @classmethod
    def begin(
        cls, config: TrainConfig, capture: Capture, avatar: Avatar, clips: Mapping[str, range]
    ) -> "RegisteredMaps":
        """Return the maps of a run before the first is fitted; none without a garment or a use for them."""
        used = bool(config.schedule.pretraining_fraction) and len(avatar.garment_control_points()) > 0
        registered = clips if used else {}
        unseen = {
            name: frozenset(frame for frame in clip if not capture.cameras_with_image(name, frame))
            for name, clip in registered.items()
        }
        return cls(registered, len(avatar.control.cells), unseen, avatar.device)

    def _divide(self, frames: Mapping[str, range]) -> None:
        """Divide frames without a map among the workers, by sequences: each map follows from the last."""
        shares = divide_sequences(frames, workers.world_size())
        self.share = frozenset(shares[workers.rank()])
        """Sequences of which this worker has the maps, until all are fitted."""
        self.own = [(name, frame) for name in shares[workers.rank()] for frame in frames[name]]
        """Sequence and frame of what this worker fits, in that order."""
        self.longest = max(sum(len(frames[name]) for name in share) for share in shares)
        """Frames that the busiest worker fits."""
        self.count = 0
        """Frames of these that it has fitted."""

    @property
    def frames_left(self) -> int:
        """Frames that the busiest worker has yet to fit."""
        return max(self.longest - self.count, 0)

    @property
    def complete(self) -> bool:
        """Whether every worker has fitted its frames, or will fit no more."""
        return self.count >= self.longest

    @property
    def unregistered(self) -> int:
        """Frames that got no map, because time was short."""
        return sum(len(clip) - int(self.fitted[name]) for name, clip in self.clips.items())

    def has_map(self, sequence: str, frame: int) -> bool:
        """Return whether a frame has a map that the network can learn from."""
        if sequence not in self.clips:
            return False
        first = self.clips[sequence].start
        fitted = range(first, first + int(self.fitted[sequence]))
        return frame in fitted and frame not in self.unseen[sequence]

    @property
    def usable(self) -> bool:
        """Whether any frame has a map that the network can learn from."""
        return any(self.has_map(name, frame) for name, clip in self.clips.items() for frame in clip)

    def targets(self, cursors: Sequence[RolloutCursor]) -> tuple[Float[Tensor, "b p 3"], Bool[Tensor, " b"]]:
        """Return the map of the frame that each rollout sees, zeros without one, and which have one."""
        has_map = [self.has_map(cursor.sequence, cursor.frame) for cursor in cursors]
        points = next(iter(self.offsets.values())).shape[1:]
        maps = [
            self.offsets[cursor.sequence][cursor.frame] if has else torch.zeros(points, device=self.device)
            for has, cursor in zip(has_map, cursors, strict=True)
        ]
        return torch.stack(maps), send(torch.tensor(has_map), self.device)

    def all_gather(self) -> None:
        """Give all workers what each has fitted; it ends registration."""
        workers.all_reduce([*self.offsets.values(), *self.fitted.values()])
        self.count = self.longest

    def state_dict(self) -> dict[str, Tensor]:
        """Return the maps, and how far fitting them has come."""
        tensors = {f"offsets.{name}": maps for name, maps in self.offsets.items()}
        tensors |= {f"fitted.{name}": fitted for name, fitted in self.fitted.items()}
        return tensors | {"complete": torch.tensor(self.complete)}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `state_dict` returned, of all workers (`merge_registration`); divide what is left.

        Raises:
            KeyError: a sequence is missing.
        """
        self.offsets = {name: tensors[f"offsets.{name}"].to(self.device, copy=True) for name in self.offsets}
        self.fitted = {name: tensors[f"fitted.{name}"].clone() for name in self.fitted}
        left = {
            name: range(clip.start + int(self.fitted[name]), clip.stop) for name, clip in self.clips.items()
        }
        self._divide({} if tensors["complete"] else left)
        for name in self.clips.keys() - self.share if not self.complete else ():
            # The sum over workers ends registration, and these are another's.
            self.offsets[name].zero_()
            self.fitted[name].zero_()


def divide_sequences(clips: Mapping[str, range], workers: int) -> list[list[str]]:
    """Return which sequences each worker gets, so that none has much more to do than another."""
    shares: list[list[str]] = [[] for _ in range(workers)]
    for name in sorted(clips, key=lambda name: -len(clips[name])):
        min(shares, key=lambda share: sum(len(clips[n]) for n in share)).append(name)
    return shares
