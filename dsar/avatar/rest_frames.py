"""Frames in which the cloth can be taken to hang at rest."""

import itertools
from collections.abc import Callable

import torch
from jaxtyping import Float, Float32
from torch import Tensor

SETTLE_SECONDS = 1.0
"""Cloth is taken to be at rest when the body has hardly moved for this long."""


def peak_joint_speed(joints: Float[Tensor, "f j 3"], fps: float) -> Float[Tensor, " f"]:
    """Return the largest mean joint speed (m/s) of the last second at each frame.

    Before the first frame the body is taken to have stood still.
    """
    speed = joints.new_zeros(len(joints))
    speed[1:] = (joints[1:] - joints[:-1]).norm(dim=-1).mean(-1) * fps
    length = round(SETTLE_SECONDS * fps)
    padded = torch.cat([speed.new_zeros(length - 1), speed])
    return padded.unfold(0, length, 1).amax(-1)


def find_rest_frames(
    transforms: dict[str, Float32[Tensor, "_ j 4 4"]],
    fps: float,
    count: int,
    per_sequence: int,
    usable: Callable[[str, int], object],
) -> list[tuple[str, int]]:
    """Return the `count` stillest frames, at most `per_sequence` from any sequence.

    `transforms` holds T_world_rest of the joints for each frame of each sequence; `usable` tells of a
    sequence's frame whether it may be taken.
    """
    candidates = []
    for name, frames in transforms.items():
        # Where the transforms carry two points tells how fast each joint translates and turns.
        points = frames[:, :, :3, 3] + frames[:, :, :3, :3].sum(-1) * 0.3
        scores = peak_joint_speed(points, fps).cpu()
        stillest = (int(i) for i in scores.argsort(stable=True) if usable(name, int(i)))
        candidates += [(float(scores[i]), name, i) for i in itertools.islice(stillest, per_sequence)]
    return [(name, frame) for _, name, frame in sorted(candidates)[:count]]
