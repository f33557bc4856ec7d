"""The true cloth of a capture as offsets from its garment at rest, carried by skinning."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.garment_chart import diffuse_weights
from dsar.body.skinning import blend_transforms, forward_kinematics
from dsar.data.captures.multiview import MultiViewCapture
from dsar.types import Body

SMOOTHING = 0.12
"""Metres over which skin weights spread onto the garment."""
HELD_OUT = ("near", "far")
"""Test sequences that have a column of their own."""
_MILLIMETRES = 1000.0

Offsets = dict[str, Float[np.ndarray, "f n 3"]]
"""By sequence: displacement of the garment's points, in the frame of the body at rest, metres."""


@dataclass(frozen=True)
class Subject:
    """Motions and true cloth of a capture; the garment's points are rows from the waist, closed around."""

    name: str
    body: Body
    fps: float
    shape: tuple[int, int]
    """Rows and columns of the garment's points; the body holds the first row."""
    train: tuple[str, ...]
    validation: tuple[str, ...]
    held_out: tuple[str, ...]
    transforms: dict[str, Float[Tensor, "f j 4 4"]]
    """T_world_rest of the body's joints."""
    rest: Float[Tensor, "n 3"]
    """Where the points hang at rest, in the body's rest pose, metres: means over training's first frames."""
    weights: Float[Tensor, "n j"]
    """Skin weights of the points."""
    turns: dict[str, Float[np.ndarray, "f n 3 3"]]
    """Linear parts of the transforms that carry the points."""
    offsets: Offsets
    """What is to be predicted."""
    second: Offsets
    """Another true outcome, of the motions that have one."""

    @property
    def names(self) -> tuple[str, ...]:
        """All sequences, training first."""
        return tuple(self.transforms)

    def error(self, name: str, offsets: Float[np.ndarray, "f n 3"]) -> float:
        """Return the root mean square distance to the true cloth, mm, of the points that the body lets go."""
        free = slice(self.shape[1], None)
        way = (offsets - self.offsets[name])[:, free, None]
        apart = (self.turns[name][:, free] * way).sum(-1)
        return _MILLIMETRES * float(np.sqrt(np.square(apart).sum(-1).mean()))

    def resting(self) -> Offsets:
        """Return the template: no offset anywhere."""
        return {name: np.zeros_like(offsets) for name, offsets in self.offsets.items()}


def load_subject(capture: MultiViewCapture) -> Subject:
    """Return training, test and validation of a capture whose sequences have garment truth.

    Raises:
        CaptureError: a sequence has no garment truth.
    """
    train, validation = capture.splits["train"], capture.splits.get("unseen_validation", ())
    held_out = [name for name in HELD_OUT if name in capture.splits["test"]]
    names = (*train, *held_out, *validation)
    transforms = {
        name: forward_kinematics(
            capture.body, capture.motions[name].rotations, capture.motions[name].translations
        )
        for name in names
    }
    truth = {name: torch.from_numpy(capture.garment(name)) for name in names}
    points = truth[train[0]].shape[1]
    # Each of the r - 1 strips of a closed tube has two triangles a column.
    columns = points - len(capture.garment_faces(train[0])) // 2
    rest, weights = _find_rest(capture.body, train, transforms, truth)
    carried = {name: blend_transforms(weights, frames) for name, frames in transforms.items()}
    return Subject(
        name=capture.name,
        body=capture.body,
        fps=capture.fps,
        shape=(points // columns, columns),
        train=tuple(train),
        validation=tuple(validation),
        held_out=tuple(held_out),
        transforms=transforms,
        rest=rest,
        weights=weights,
        turns={name: frames[..., :3].numpy() for name, frames in carried.items()},
        offsets={name: (_unskin(carried[name], truth[name]) - rest).numpy() for name in names},
        second={
            name: (_unskin(carried[name], torch.from_numpy(capture.garment(name, run=1))) - rest).numpy()
            for name in names
            if capture.garment_runs(name) > 1
        },
    )


def _find_rest(
    body: Body, train: tuple[str, ...], transforms: dict[str, Tensor], truth: dict[str, Tensor]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n j"]]:
    """Return the resting points and their skin weights: the pelvis alone carries a first guess."""
    guesses = [_unskin(transforms[name][0, :1, :3], truth[name][0]) for name in train]
    weights = diffuse_weights(body, torch.stack(guesses).mean(0), SMOOTHING)
    rest = [_unskin(blend_transforms(weights, transforms[name][0]), truth[name][0]) for name in train]
    return torch.stack(rest).mean(0), weights


def _unskin(carried: Float[Tensor, "*b 3 4"], points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Return where points lie in the body's rest pose."""
    return torch.linalg.solve(carried[..., :3], (points - carried[..., 3])[..., None])[..., 0]
