"""Tracks: a motion as the transforms of every joint, and what these were like a while ago.

A *track* holds T_world_rest of every joint per frame, and after it, for each of some lags, its running mean
over the past, as far as the body turned and moved its limbs: where inertia would have left the cloth.
A *context* is what one step sees: a frame's transforms, those of the two frames before, newest first, then
the means.
"""

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor


def with_lags(
    transforms: Float[Tensor, "f j 4 4"], pelvis: Float[Tensor, "3"], fps: float, lags: tuple[float, ...]
) -> Float[Tensor, "f k j 4 4"]:
    """Return the track of a motion.

    A mean forgets by a factor of e in its lag. It is of transforms relative to the pelvis's place in
    the world, and is moved to the newest such place: a steady walk does not lag behind itself. Before
    the first frame the body is taken to have stood in it.

    Args:
        transforms: T_world_rest by frame and joint; the pelvis is joint 0.
        pelvis: Its place at rest, metres.
        fps: Frames per second.
        lags: Time constants, seconds.
    """
    root = torch.zeros_like(transforms)
    root[..., :3, 3] = (transforms[:, 0, :3, :3] @ pelvis + transforms[:, 0, :3, 3])[:, None]
    relative = transforms - root
    keep = transforms.new_tensor([math.exp(-1 / (lag * fps)) for lag in lags])[:, None, None, None]
    mean = relative[0].expand(len(lags), *relative.shape[1:])
    means = []
    for newest in relative:
        mean = keep * mean + (1 - keep) * newest
        means.append(mean)
    return torch.cat([transforms[:, None], torch.stack(means) + root[:, None]], 1)


def contexts(track: Float[Tensor, "f k j 4 4"], frames: Int64[Tensor, " b"]) -> Float[Tensor, "b t j 4 4"]:
    """Return the contexts of frames; the first frame precedes itself."""
    index = (frames[:, None] - torch.arange(3)).clamp_min(0)
    return torch.cat([track[index, 0], track[frames, 1:]], 1)
