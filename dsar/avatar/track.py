"""Tracks: a motion as what each step of a rollout sees of it.

A *context* is what one step sees: T_world_rest of every joint in a frame and in the two frames before it,
newest first, and then, for each of some lags, its running mean over the past, as far as the body turned and
moved its limbs: where inertia would have left the cloth. A *track* holds the context of every frame.

Where a body jumps (a cut, a glitch of the capture), its past jumps with it: nothing on earth moves so fast,
and cloth that were told of it would fly apart.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.geometry.rotations import heading_matrix

JUMP_SPEED = 12.0
"""Metres per second of the pelvis above which a body has not moved, but jumped."""
JUMP_TURN = 20 * math.pi
"""Radians per second of the pelvis above which it has, too."""


def make_track(
    transforms: Float[Tensor, "f j 4 4"], pelvis: Float[Tensor, "3"], fps: float, lags: tuple[float, ...]
) -> Float[Tensor, "f t j 4 4"]:
    """Return the track of a motion; before its first frame the body is taken to have stood in it.

    A mean forgets by a factor of e in its lag. It is of transforms relative to the pelvis's place in
    the world, and is moved to the newest such place: a steady walk does not lag behind itself.

    Args:
        transforms: T_world_rest by frame and joint; the pelvis is joint 0.
        pelvis: Its place at rest, metres.
        fps: Frames per second.
        lags: Time constants, seconds.
    """
    jumps = find_jumps(transforms, pelvis, fps)
    if not jumps:
        return torch.cat([_newest(transforms), _means(transforms, pelvis, fps, lags)], 1)
    placements = _placements(transforms, pelvis, jumps)
    steady = placements.inverse()[:, None] @ transforms
    track = torch.cat([_newest(steady), _means(steady, pelvis, fps, lags)], 1)
    return placements[:, None, None] @ track


def find_jumps(transforms: Float[Tensor, "f j 4 4"], pelvis: Float[Tensor, "3"], fps: float) -> list[int]:
    """Return the frames in which a body is where it cannot have come from the frame before."""
    turns, places = transforms[:, 0, :3, :3], _pelvis(transforms, pelvis)
    far = places.diff(dim=0).norm(dim=-1) > JUMP_SPEED / fps
    # The trace of a rotation by an angle is 1 + 2 cos(angle).
    change = turns[:-1].mT @ turns[1:]
    cosines = (change.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    about = cosines < math.cos(min(JUMP_TURN / fps, math.pi))
    return [int(frame) + 1 for frame in (far | about).nonzero()]


def _newest(transforms: Float[Tensor, "f j 4 4"]) -> Float[Tensor, "f 3 j 4 4"]:
    """Return each frame and the two before it, newest first."""
    frames = torch.arange(len(transforms), device=transforms.device)
    return transforms[(frames[:, None] - torch.arange(3, device=transforms.device)).clamp_min(0)]


def _means(
    transforms: Float[Tensor, "f j 4 4"], pelvis: Float[Tensor, "3"], fps: float, lags: tuple[float, ...]
) -> Float[Tensor, "f l j 4 4"]:
    root = torch.zeros_like(transforms)
    root[..., :3, 3] = _pelvis(transforms, pelvis)[:, None]
    relative = transforms - root
    keep = transforms.new_tensor([math.exp(-1 / (lag * fps)) for lag in lags])[:, None, None, None]
    mean = relative[0].expand(len(lags), *relative.shape[1:])
    means = []
    for newest in relative:
        mean = keep * mean + (1 - keep) * newest
        means.append(mean)
    return torch.stack(means) + root[:, None]


def _pelvis(transforms: Float[Tensor, "f j 4 4"], pelvis: Float[Tensor, "3"]) -> Float[Tensor, "f 3"]:
    return transforms[:, 0, :3, :3] @ pelvis + transforms[:, 0, :3, 3]


def _placements(
    transforms: Float[Tensor, "f j 4 4"], pelvis: Float[Tensor, "3"], jumps: list[int]
) -> Float[Tensor, "f 4 4"]:
    """Return, by frame, what jumps have done so far to the body's place on the ground and its heading.

    Without its jump the pelvis would have gone on straight and turning as it did in the frame before.
    """
    stands = torch.eye(4).to(transforms).repeat(len(transforms), 1, 1)
    stands[:, :3, :3] = heading_matrix(transforms[:, 0, :3, :3])
    stands[:, :3:2, 3] = _pelvis(transforms, pelvis)[:, ::2]
    placements = torch.eye(4).to(transforms).repeat(len(transforms), 1, 1)
    for frame in jumps:
        last = max(frame - 2, 0)
        before, newest = placements[[last, frame - 1]].inverse() @ stands[[last, frame - 1]]
        expected = newest @ before.inverse() @ newest
        expected[:3, 3] = 2 * newest[:3, 3] - before[:3, 3]
        placements[frame:] = stands[frame] @ expected.inverse()
    return placements
