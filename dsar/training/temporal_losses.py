"""The three adaptive temporal regularisers, and the frames that they look back on.

Offsets, positions and accelerations are compared in centimetres.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from dsar.avatar.input_maps import REFERENCE_FPS
from dsar.config import LossConfig
from dsar.devices import send
from dsar.network import NetworkOutput
from dsar.training.losses import CENTIMETRES

GAMMA = 0.1
"""Weight gamma of L_feat at every level of features."""
_ROTATION_AND_SCALE = slice(0, 7)
"""Channels of the appearance residuals that L_pred compares: quaternion and log-scale."""
_RECORDS = 3


@dataclass(frozen=True)
class TemporalRecord:
    """What the temporal losses remember of one frame of a batch of rollouts."""

    output: NetworkOutput
    """The network's residual maps and features."""
    posed: Float[Tensor, "b p 3"]
    """Deformed control points in the world, metres."""

    def detach(self) -> "TemporalRecord":
        """Cut the record from the autograd graph."""
        output = NetworkOutput(
            self.output.offset.detach(),
            self.output.appearance.detach(),
            tuple(feature.detach() for feature in self.output.features),
        )
        return TemporalRecord(output, self.posed.detach())


class TemporalHistory:
    """The last frames of a batch of rollouts: records of three, motion magnitudes of a window."""

    def __init__(self, window: int) -> None:
        self.records: deque[TemporalRecord] = deque(maxlen=_RECORDS)
        self.magnitudes: deque[Float[Tensor, "b 1 h w"]] = deque(maxlen=max(2, window))
        """Motion magnitudes V of the window's frames, oldest first."""

    def append(self, record: TemporalRecord, magnitude: Float[Tensor, "b 1 h w"]) -> None:
        """Add the newest frame; the oldest ones go."""
        self.records.append(record)
        self.magnitudes.append(magnitude)

    def detach(self) -> None:
        """Cut all records from the autograd graph."""
        for _ in range(len(self.records)):
            self.records.append(self.records.popleft().detach())

    def state_dict(self) -> dict[str, Tensor]:
        """Return the records and magnitudes as named tensors."""
        tensors: dict[str, Tensor] = {}
        for i, record in enumerate(self.records):
            tensors |= {f"record.{i}.offset": record.output.offset, f"record.{i}.posed": record.posed}
            tensors[f"record.{i}.appearance"] = record.output.appearance
            tensors |= {f"record.{i}.feature.{k}": f for k, f in enumerate(record.output.features)}
        return tensors | {f"magnitude.{i}": magnitude for i, magnitude in enumerate(self.magnitudes)}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            KeyError: a part of a record is missing.
        """
        self.records.clear()
        while f"record.{len(self.records)}.offset" in tensors:
            prefix = f"record.{len(self.records)}"
            levels = sum(name.startswith(f"{prefix}.feature.") for name in tensors)
            features = tuple(tensors[f"{prefix}.feature.{k}"] for k in range(levels))
            output = NetworkOutput(tensors[f"{prefix}.offset"], tensors[f"{prefix}.appearance"], features)
            self.records.append(TemporalRecord(output, tensors[f"{prefix}.posed"]))
        self.magnitudes.clear()
        while f"magnitude.{len(self.magnitudes)}" in tensors:
            self.magnitudes.append(tensors[f"magnitude.{len(self.magnitudes)}"])


def temporal_losses(
    records: Sequence[TemporalRecord],
    magnitudes: Sequence[Float[Tensor, "b 1 h w"]],
    ages: list[int],
    occupied: Float[Tensor, "1 1 h w"],
    cells: Int64[Tensor, " p"],
    config: LossConfig,
) -> dict[str, Float[Tensor, ""]]:
    """Return the weighted temporal losses of the newest record against the one or two before it, by name.

    Args:
        records: Those of the newest frame and up to two before it, the newest last.
        magnitudes: The motion magnitudes V of the window's frames, metres per 1/30 s, the newest last.
        ages: Frames that each rollout has seen before the newest: rollouts without enough past are left out.
        occupied: 1 where a pixel of the network's maps holds texels.
        cells: The control points' pixels, flat.
        config: Weights of the losses.
    """
    newest, losses = records[-1], {}
    if len(records) < 2:
        return losses
    one_before, two_before = (_have_seen(ages, past, newest.posed) for past in (1, 2))
    previous, scale = records[-2], config.temporal_scale
    weights = {frame: adaptive_weight(magnitudes, ages, frame, config) * occupied for frame in (-1, -2)}

    def over_rollouts(values: Float[Tensor, "b ..."], valid: Float[Tensor, " b"]) -> Float[Tensor, ""]:
        flat = values.flatten(1)
        return ((flat.mean(1) if config.reduction == "mean" else flat.sum(1)) * valid).mean()

    change = weights[-1] * prediction_change(newest.output, previous.output)
    losses["prediction"] = scale * config.prediction * over_rollouts(change, one_before)
    changes = torch.stack(
        [over_rollouts(change, one_before) for change in feature_changes(newest.output, previous.output)]
    )
    losses["feature"] = scale * config.feature * GAMMA * changes.sum()
    if len(records) > 2:
        acceleration = squared_acceleration(newest.posed, previous.posed, records[-3].posed)
        # It is the acceleration of the frame in the middle, and weighed by its motion.
        jolt = weights[-2].flatten(1)[:, cells] * acceleration
        losses["smoothness"] = scale * config.smoothness * over_rollouts(jolt, two_before)
    return losses


def adaptive_weight(
    magnitudes: Sequence[Float[Tensor, "b 1 h w"]], ages: list[int], frame: int, config: LossConfig
) -> Float[Tensor, "b 1 h w"]:
    """Return w = exp(-V / tau_reg) of each pixel (paper equation 17); 1 where `config.adaptive` is off.

    V is that of a frame (-1: the newest), or the window's largest. What came before a rollout's restart is
    another motion, and does not count.
    """
    if not config.adaptive:
        return torch.ones_like(magnitudes[-1])
    frames = [frame] if config.magnitude == "frame" else range(-len(magnitudes), 0)
    own = [magnitudes[k] * _have_seen(ages, -1 - k, magnitudes[k])[:, None, None, None] for k in frames]
    return torch.exp(-torch.stack(own).amax(0) * REFERENCE_FPS / config.tau)


def feature_changes(current: NetworkOutput, past: NetworkOutput) -> list[Float[Tensor, "b c _ _"]]:
    """Return the squared change of the features of each level between frames.

    Weighed by gamma and summed it is L_feat (paper equation 18).
    """
    pairs = zip(current.features, past.features, strict=True)
    return [(now - before).square() for now, before in pairs]


def prediction_change(current: NetworkOutput, past: NetworkOutput) -> Float[Tensor, "b 1 h w"]:
    """Return the squared change of offset (cm), quaternion and log-scale between frames, unweighted.

    Weighed by w and summed it is L_pred (paper equation 19).
    """
    moved = (current.offset - past.offset) * CENTIMETRES
    reshaped = current.appearance[:, _ROTATION_AND_SCALE] - past.appearance[:, _ROTATION_AND_SCALE]
    return moved.square().sum(1, keepdim=True) + reshaped.square().sum(1, keepdim=True)


def squared_acceleration(
    newest: Float[Tensor, "b p 3"], middle: Float[Tensor, "b p 3"], oldest: Float[Tensor, "b p 3"]
) -> Float[Tensor, "b p"]:
    """Return the squared acceleration, cm per frame squared, of points at the middle one of three frames.

    Weighed by w of the frame in the middle and summed it is L_sm (paper equations 20, 21).
    """
    acceleration = (newest - 2 * middle + oldest) * CENTIMETRES
    return acceleration.square().sum(-1)


def _have_seen(ages: list[int], past: int, like: Tensor) -> Float[Tensor, " b"]:
    """Return 1 for rollouts that have seen the frame so many before the newest, 0 for others."""
    return send(torch.tensor([float(age >= past) for age in ages], dtype=like.dtype), like.device)
