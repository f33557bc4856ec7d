"""The network's input maps: where control points are, how they move, and where inertia would have them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from dsar.avatar.control_grid import ControlGrid
from dsar.avatar.guards import LIMITS, Guard, GuardCounts
from dsar.body.skinning import blend_transforms
from dsar.config import ModelConfig
from dsar.geometry.rotations import heading_matrix

REFERENCE_FPS = 30.0
"""Reference rate: velocities are metres per 1/30 s whatever the motion's own rate."""


@dataclass(frozen=True)
class InputMaps:
    """The input maps of a batch of frames on the network's grid; cells without a control point are zero."""

    maps: Float[Tensor, "b c h w"]
    """Position, velocity, acceleration and lags, metres and reference frames; not standardised."""
    magnitude: Float[Tensor, "b 1 h w"]
    """Motion magnitude V, metres per 1/30 s."""
    guard_counts: GuardCounts
    """How many control points had a velocity or a lag cut, by frame of the batch."""


def make_input_maps(
    control: ControlGrid,
    motion_windows: Float[Tensor, "b t j 4 4"],
    pelvis: Float[Tensor, "3"],
    fps: float,
    model: ModelConfig,
    cloth: Float[Tensor, "b g 6"] | None = None,
) -> InputMaps:
    """Return the input maps p, dp and the motion magnitudes V = |dp| of a batch of frames (paper equation 6).

    The previous offset joins them in the network's encoder. Channels, in their order:

    - position p: relative to the pelvis's place on the ground, turned by the inverse of its heading; height
      and the direction of gravity are the world's;
    - velocity dp, if the model has it: true world velocity, so that a spin or a walk is visible, along the
      control points' axes, cut at `Limits.speed`; its length, whatever the model has, is V;
    - acceleration, if the model has it: change of the cut velocity, along the same axes;
    - for each running mean of the motion window the lag: the way from the control point to where that mean
      puts it, along the same axes, cut at `Limits.lag`;
    - the motion prior, if the model has one: offset and its change at the garments' control points, along the
      axes of the network's offsets, zero elsewhere.

    Args:
        control: Control points.
        motion_windows: T_world_rest of joints: a frame, the two before it, and running means (see `driving`).
        pelvis: Its position at rest, metres.
        fps: Frames per second of the motion.
        model: Which maps there are, and along which axes.
        cloth: The motion prior; the garments' control points are the last.
    """
    rows = motion_windows[..., :3, :].transpose(-3, -2).flatten(-2)
    points = (rows @ control.basis.mT).mT
    pelvis_transforms = motion_windows[:, 0, 0]
    root = pelvis_transforms[:, :3, :3] @ pelvis + pelvis_transforms[:, :3, 3]
    headings = heading_matrix(pelvis_transforms[:, :3, :3])
    if model.axes == "surface":
        axes = blend_transforms(control.weights, motion_windows[:, :1])[:, 0, :, :, :3] @ control.frames
    else:
        axes = headings[:, None].expand(-1, len(control.cells), -1, -1)
    ground = root.clone()
    ground[:, 1] = 0.0
    rate = fps / REFERENCE_FPS
    position = (points[:, 0] - ground[:, None]) @ headings
    velocities, fast = limit_norm((points[:, :2] - points[:, 1:3]) * rate, LIMITS.speed)
    velocity, velocity_before = velocities.unbind(1)
    lags, far = limit_norm(points[:, 3:] - points[:, :1], LIMITS.lag)
    channels = [position]
    if model.velocity:
        channels.append(_along(axes, velocity))
    if model.acceleration:
        channels.append(_along(axes, (velocity - velocity_before) * rate))
    channels += _along(axes[:, None], lags).unbind(1)
    if model.prior == "cloth":
        if cloth is None:
            raise ValueError("the model has a motion prior, and the frames come without it")
        channels.append(nn.functional.pad(cloth, (0, 0, len(control.cells) - cloth.shape[1], 0)))
    values = torch.cat([*channels, velocity.norm(dim=-1, keepdim=True)], -1)
    grid = values.new_zeros(len(values), values.shape[-1], control.size[0] * control.size[1])
    grid[:, :, control.cells] = values.transpose(1, 2)
    grid = grid.reshape(len(values), -1, *control.size)
    return InputMaps(grid[:, :-1], grid[:, -1:], {Guard.SPEED: fast[:, 0], Guard.LAG: far.sum(1)})


def limit_norm(
    vectors: Float[Tensor, "b k p 3"], limit: float
) -> tuple[Float[Tensor, "b k p 3"], Int[Tensor, "b k"]]:
    """Shorten vectors that are longer than the limit, keeping their direction; return how many were, too."""
    norm = vectors.norm(dim=-1, keepdim=True)
    return vectors * (limit / norm.clamp_min(limit)), (norm > limit).sum((2, 3))


def _along(axes: Float[Tensor, "*#b p 3 3"], vectors: Float[Tensor, "*#b p 3"]) -> Float[Tensor, "..."]:
    """Return the components of world vectors along axes given as columns."""
    return (vectors[..., :, None] * axes).sum(-2)
