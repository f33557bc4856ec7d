"""Everything that changes while a worker trains, in one record."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.config import TrainConfig
from dsar.network import NetworkState
from dsar.training.optimizers import make_optimizers
from dsar.training.registered_maps import RegisteredMaps
from dsar.training.rest import RestOffsets
from dsar.training.rollouts import RolloutBatch
from dsar.training.temporal_losses import TemporalHistory
from dsar.types import Capture


@dataclass
class TrainingState:
    """What a checkpoint holds: a run goes on from it bit for bit."""

    avatar: Avatar
    """Template and network."""
    rest: RestOffsets
    """The garment in still frames."""
    optimizers: Mapping[str, torch.optim.Optimizer]
    """`adam`, and `muon` where it is used."""
    rollouts: RolloutBatch
    """Where this worker's rollouts stand."""
    network: NetworkState
    """What the network remembers of them."""
    history: TemporalHistory
    """What the temporal losses remember of them."""
    registered: RegisteredMaps
    """The registered maps, as far as this worker has them."""
    step: int = 0
    """Updates done."""
    progress: float = 0.0
    """Share of the schedule that is done, in [0, 1]."""
    skipped: float = 0.0
    """Updates of the schedule that were passed over, because time was short."""
    seconds: float = 0.0
    """Time that updates and registration took."""

    @property
    def cut(self) -> tuple[int, int]:
        """How many updates were passed over, and how many frames not registered, because time was short."""
        return round(self.skipped), self.registered.unregistered if self.registered.complete else 0

    @classmethod
    def begin(
        cls,
        config: TrainConfig,
        capture: Capture,
        avatar: Avatar,
        clips: Mapping[str, range],
        rest_frames: list[tuple[str, int]],
    ) -> "TrainingState":
        """Return the state before the first update.

        Args:
            config: The settings of the run.
            capture: Its images.
            avatar: The avatar to train.
            clips: Frames of each training sequence.
            rest_frames: Sequence and frame of the still frames that the template is fitted to.
        """
        schedule, rest = config.schedule, RestOffsets(avatar, rest_frames)
        return cls(
            avatar=avatar,
            rest=rest,
            optimizers=make_optimizers(avatar, rest, schedule),
            rollouts=RolloutBatch(clips, schedule.rollouts_per_worker, schedule.mirrored_fraction),
            network=avatar.initial_state(schedule.rollouts_per_worker),
            history=TemporalHistory(config.model.window),
            registered=RegisteredMaps.begin(config, capture, avatar, clips),
        )

    def advance(self, steps: int, skipped: float) -> None:
        """Count an update of so many planned ones, and those that are passed over with it."""
        self.step += 1
        self.skipped += skipped
        # A share of whole numbers, as long as it can be: sums of shares would round.
        by_count, onward = self.step / steps, min(self.progress + (1 + skipped) / steps, 1.0)
        self.progress = onward if self.skipped else max(by_count, self.progress)

    def state_dict(self) -> dict[str, Tensor]:
        """Return all of it as named tensors; the first part of a name says of what it is."""
        parts = {name: _moments(optimizer) for name, optimizer in self.optimizers.items()}
        parts |= {"avatar": self.avatar.state_dict(), "rollouts": self.rollout_tensors()}
        parts["registration"] = self.registered.state_dict() | {"rest": self.rest.offsets.detach()}
        tensors = {f"{part}.{name}": value for part, named in parts.items() for name, value in named.items()}
        tensors["step"] = torch.tensor(self.step)
        tensors["progress"] = torch.tensor(self.progress, dtype=torch.float64)
        return tensors

    def rollout_tensors(self) -> dict[str, Tensor]:
        """Return where the rollouts stand, and what the network and the temporal losses remember of them."""
        network, cursors = self.network, self.rollouts.state_dict()
        tensors = {"fresh": network.fresh, "motion": network.motion}
        tensors |= {"offsets": network.offsets, "memory": network.memory}
        tensors |= {f"window.{i}": level for i, level in enumerate(network.window)}
        tensors |= {f"cursors.{sequence}": rows for sequence, rows in cursors.items()}
        return tensors | self.history.state_dict()

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `state_dict` returned, or the parts of it that are given.

        Raises:
            KeyError, ValueError, RuntimeError: tensors are missing in a part, or have another shape.
        """
        parts: dict[str, dict[str, Tensor]] = {}
        for name, value in tensors.items():
            part, _, rest = name.partition(".")
            parts.setdefault(part, {})[rest] = value
        for part, named in parts.items():
            self._load_part(part, named)

    def _load_part(self, part: str, tensors: dict[str, Tensor]) -> None:
        if part == "avatar":
            self.avatar.load_state_dict(tensors)
        elif part in self.optimizers:
            _load_moments(self.optimizers[part], tensors)
        elif part == "rollouts":
            prefix, device = "cursors.", self.avatar.device
            cursors = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
            tensors = {k: v.to(device) for k, v in tensors.items() if not k.startswith(prefix)}
            self.network = NetworkState(
                fresh=tensors["fresh"],
                window=tuple(tensors[f"window.{i}"] for i in range(len(self.network.window))),
                motion=tensors["motion"],
                offsets=tensors["offsets"],
                memory=tensors["memory"],
            )
            self.history.load_state_dict(tensors)
            self.rollouts.load_state_dict(cursors)
        elif part == "registration":
            self.registered.load_state_dict(tensors)
            with torch.no_grad():
                self.rest.offsets.copy_(tensors["rest"])
        elif part == "step":
            self.step = int(tensors[""])
        elif part == "progress":
            self.progress = float(tensors[""])
        else:
            raise KeyError(part)


def _moments(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Return an optimiser's moments; the parameters' order is the key."""
    slots = optimizer.state_dict()["state"]
    return {f"{index}.{name}": value for index, slot in slots.items() for name, value in slot.items()}


def _load_moments(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    slots: dict[int, dict[str, Tensor]] = {}
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    for key, value in tensors.items():
        index, name = key.split(".", 1)
        if value.ndim and value.shape != parameters[int(index)].shape:
            raise ValueError(f"{key} has shape {tuple(value.shape)}, its parameter another")
        slots.setdefault(int(index), {})[name] = value
    optimizer.load_state_dict({**optimizer.state_dict(), "state": slots})
