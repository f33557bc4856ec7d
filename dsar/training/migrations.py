"""Checkpoints of format 3, the names of whose tensors were others.

Format 4 has the names below, and keeps the rollouts' cursors among its tensors.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

OLDEST_VERSION = 3
"""Oldest format that is read."""
AVATAR_NAMES = {
    "cells": "control.cells",
    "control_points": "control.points",
    "control_weights": "control.weights",
    "control_frames": "control.frames",
    "map_mean": "statistics.map_mean",
    "map_scale": "statistics.map_scale",
    "speed_scale": "statistics.magnitude_scale",
    "pose_mean": "principal_poses.mean",
    "pose_basis": "principal_poses.basis",
    "pose_deviation": "principal_poses.deviation",
    "network.attention.age": "network.attention.position_embedding",
    "network.bank.attention.age": "network.bank.attention.position_embedding",
    "network.bank.recall_logit": "network.bank.memory_logit",
    "network.encoder.identity": "network.encoder.uv_features",
    "network.encoder.poses.": "network.encoder.pyramid.",
    "network.encoder.offsets.": "network.encoder.offset_pyramid.",
    "network.mixing.": "network.aggregation.",
}
"""Old and new name of tensors in avatar.safetensors, or of all that begin so where it ends in a dot."""
ROLLOUT_NAMES = {"speed.": "magnitude."}
"""The same in rollouts-<rank>.safetensors."""


def rename_tensors(
    tensors: Mapping[str, Tensor], version: int, names: Mapping[str, str] = AVATAR_NAMES
) -> dict[str, Tensor]:
    """Return the tensors of a checkpoint of some format by the names that they have now."""
    if version > OLDEST_VERSION:
        return dict(tensors)
    return {_new_name(name, names): value for name, value in tensors.items()}


def _new_name(name: str, names: Mapping[str, str]) -> str:
    if name in names:
        return names[name]
    prefixes = (old for old in names if old.endswith(".") and name.startswith(old))
    return next((names[old] + name.removeprefix(old) for old in prefixes), name)


def cursor_tensors(cursors: Iterable[Mapping[str, Any]]) -> dict[str, Tensor]:
    """Return the cursors that format 3 kept in rollouts-<rank>.json as `RolloutBatch` keeps them.

    Raises:
        KeyError, TypeError: they are something else.
    """
    rows: defaultdict[str, list[list[int]]] = defaultdict(list)
    for index, cursor in enumerate(cursors):
        numbers = [index, cursor["frame"], cursor["age"], int(cursor["mirrored"])]
        rows[f"cursors.{cursor['sequence']}"].append(numbers)
    return {name: torch.tensor(numbers) for name, numbers in rows.items()}
