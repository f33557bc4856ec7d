"""Driving signals: a motion as what each step of a rollout sees of it.

A *motion window* is what one step sees: T_world_rest of every joint in a frame and in the two frames before
it, newest first, and then running means over the past, one for each of some time constants, as far as the
body turned and moved its limbs: where inertia would have left the cloth. A *driving signal* holds the motion
window of every frame.

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
JUMP_ANGULAR_SPEED = 20 * math.pi
"""Radians per second of the pelvis above which it has, too."""


def driving_signal(
    transforms: Float[Tensor, "f j 4 4"],
    pelvis: Float[Tensor, "3"],
    fps: float,
    time_constants: tuple[float, ...],
) -> Float[Tensor, "f t j 4 4"]:
    """Return the driving signal of a motion; before its first frame the body is taken to have stood in it.

    A mean forgets by a factor of e in its time constant. It is of transforms relative to the pelvis's
    position in the world, and is moved to the newest such position: a steady walk does not lag behind itself.

    Args:
        transforms: T_world_rest by frame and joint; the pelvis is joint 0.
        pelvis: Its place at rest, metres.
        fps: Frames per second.
        time_constants: Of the running means, seconds.
    """
    jumps = find_jumps(transforms, pelvis, fps)
    if not jumps:
        return torch.cat(
            [_newest_frames(transforms), _running_means(transforms, pelvis, fps, time_constants)], 1
        )
    jumps_so_far = _accumulated_jumps(transforms, pelvis, jumps)
    continuous = jumps_so_far.inverse()[:, None] @ transforms
    signal = torch.cat(
        [_newest_frames(continuous), _running_means(continuous, pelvis, fps, time_constants)], 1
    )
    return jumps_so_far[:, None, None] @ signal


def find_jumps(transforms: Float[Tensor, "f j 4 4"], pelvis: Float[Tensor, "3"], fps: float) -> list[int]:
    """Return the frames in which a body is where it cannot have come from the frame before."""
    rotations, positions = transforms[:, 0, :3, :3], _pelvis_positions(transforms, pelvis)
    far = positions.diff(dim=0).norm(dim=-1) > JUMP_SPEED / fps
    # The trace of a rotation by an angle is 1 + 2 cos(angle).
    change = rotations[:-1].mT @ rotations[1:]
    cosines = (change.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    turned = cosines < math.cos(min(JUMP_ANGULAR_SPEED / fps, math.pi))
    return [int(frame) + 1 for frame in (far | turned).nonzero()]


def _newest_frames(transforms: Float[Tensor, "f j 4 4"]) -> Float[Tensor, "f 3 j 4 4"]:
    """Return each frame and the two before it, newest first."""
    frames = torch.arange(len(transforms), device=transforms.device)
    return transforms[(frames[:, None] - torch.arange(3, device=transforms.device)).clamp_min(0)]


def _running_means(
    transforms: Float[Tensor, "f j 4 4"],
    pelvis: Float[Tensor, "3"],
    fps: float,
    time_constants: tuple[float, ...],
) -> Float[Tensor, "f l j 4 4"]:
    root = torch.zeros_like(transforms)
    root[..., :3, 3] = _pelvis_positions(transforms, pelvis)[:, None]
    relative = transforms - root
    decay = transforms.new_tensor([math.exp(-1 / (seconds * fps)) for seconds in time_constants])[
        :, None, None, None
    ]
    mean = relative[0].expand(len(time_constants), *relative.shape[1:])
    means = []
    for newest in relative:
        mean = decay * mean + (1 - decay) * newest
        means.append(mean)
    return torch.stack(means) + root[:, None]


def _pelvis_positions(
    transforms: Float[Tensor, "f j 4 4"], pelvis: Float[Tensor, "3"]
) -> Float[Tensor, "f 3"]:
    return transforms[:, 0, :3, :3] @ pelvis + transforms[:, 0, :3, 3]


def _accumulated_jumps(
    transforms: Float[Tensor, "f j 4 4"], pelvis: Float[Tensor, "3"], jumps: list[int]
) -> Float[Tensor, "f 4 4"]:
    """Return, by frame, what jumps have done so far to the body's place on the ground and its heading.

    Without its jump the pelvis would have gone on straight and turning as it did in the frame before.
    """
    ground_frames = torch.eye(4).to(transforms).repeat(len(transforms), 1, 1)
    ground_frames[:, :3, :3] = heading_matrix(transforms[:, 0, :3, :3])
    ground_frames[:, :3:2, 3] = _pelvis_positions(transforms, pelvis)[:, ::2]
    jumps_so_far = torch.eye(4).to(transforms).repeat(len(transforms), 1, 1)
    for frame in jumps:
        last = max(frame - 2, 0)
        before, newest = jumps_so_far[[last, frame - 1]].inverse() @ ground_frames[[last, frame - 1]]
        expected = newest @ before.inverse() @ newest
        expected[:3, 3] = 2 * newest[:3, 3] - before[:3, 3]
        jumps_so_far[frame:] = ground_frames[frame] @ expected.inverse()
    return jumps_so_far
