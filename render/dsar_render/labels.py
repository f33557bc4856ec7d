"""Parts of a dressed body, as mattes name them."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch import Tensor

from dsar.errors import ConfigError
from dsar.types import Binding, GaussianSequence

GARMENT = "garment"
_REGIONS = {
    **dict.fromkeys(("pelvis", "spine", "collar"), "torso"),
    **dict.fromkeys(("neck", "head", "jaw", "eye"), "head"),
    **dict.fromkeys(("shoulder", "elbow"), "arm"),
    **dict.fromkeys(("wrist", "thumb", "index", "middle", "ring", "pinky"), "hand"),
    **dict.fromkeys(("hip", "knee"), "leg"),
    **dict.fromkeys(("ankle", "foot"), "foot"),
}
"""What of the body hangs on joints whose names begin so, after their side."""
_SIDED = ("arm", "hand", "leg", "foot")


@dataclass(frozen=True)
class Labels:
    """Which part of the body, by name, each Gaussian belongs to."""

    names: tuple[str, ...]
    indices: UInt8[np.ndarray, " n"]
    """Of each Gaussian's part in `names`."""


def label_sequence(sequence: GaussianSequence) -> Labels:
    """Return the parts of the body that a sequence's Gaussians belong to.

    Raises:
        ConfigError: They are bound to no body.
    """
    if sequence.binding is None:
        raise ConfigError("--aov crypto: expected Gaussians bound to a body, found none; leave crypto out")
    names, indices = label_parts(sequence.binding)
    return Labels(names, indices.numpy().astype(np.uint8))


def label_parts(binding: Binding) -> tuple[tuple[str, ...], Int[Tensor, " n"]]:
    """Return names of parts and, for each Gaussian, which of them it belongs to.

    Gaussians on a garment's chart are `garment`; all others belong to the part of the joint that moves them
    most: `head`, `torso`, `left_arm`, `right_hand`, ...
    """
    parts = [_part_of(joint) for joint in binding.joint_names]
    names = (*sorted({*parts} - {GARMENT}), GARMENT)
    by_joint = torch.tensor([names.index(part) for part in parts])
    labels = by_joint[binding.weights.argmax(-1)]
    # Charts of garments lie below the body's, at v < 0.
    return names, torch.where(binding.uv[:, 1] < 0, len(names) - 1, labels)


def _part_of(joint: str) -> str:
    """Return the part that a joint of SMPL-X moves; a joint of another name is a part of its own."""
    side, _, rest = joint.partition("_")
    if side not in ("left", "right"):
        side, rest = "", joint
    region = next((part for start, part in _REGIONS.items() if rest.startswith(start)), joint)
    return f"{side}_{region}" if side and region in _SIDED else region
