"""Position, velocity, acceleration and lag maps: what the network sees of a motion (paper equation 4)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

REFERENCE_FPS = 30.0
"""Reference rate: velocities are metres per 1/30 s whatever the motion's own rate."""
SPEED_LIMIT = 0.4
"""Metres per 1/30 s (12 m/s) at which velocities are cut, so that a teleport cannot explode the network."""
LAG_LIMIT = 1.0
"""Metres at which lags are cut, likewise."""


@dataclass(frozen=True)
class InputMaps:
    """The input maps of a batch of frames on the network's grid, metres and reference frames."""

    maps: Float[Tensor, "b c h w"]
    """Position in the heading frame; velocity, acceleration and lags along given axes; not standardised."""
    magnitude: Float[Tensor, "b 1 h w"]
    """Motion magnitude V, metres per 1/30 s."""


def limit_norm(vectors: Float[Tensor, "*b 3"], limit: float) -> Float[Tensor, "*b 3"]:
    """Shorten vectors that are longer than the limit, keeping their direction."""
    norm = vectors.norm(dim=-1, keepdim=True)
    return vectors * (limit / norm.clamp_min(limit))


def _resolve(vectors: Float[Tensor, "b p 3"], axes: Float[Tensor, "b p 3 3"]) -> Float[Tensor, "b p 3"]:
    """Return the components of world vectors along axes given as columns."""
    return (vectors[..., :, None] * axes).sum(-2)


def make_input_maps(
    points: Float[Tensor, "b t p 3"],
    headings: Float[Tensor, "b 3 3"],
    axes: Float[Tensor, "b p 3 3"],
    roots: Float[Tensor, "b 3"],
    cells: Int64[Tensor, " p"],
    size: tuple[int, int],
    fps: float,
    *,
    velocity: bool,
    acceleration: bool,
) -> InputMaps:
    """Return input maps from the posed control points of each motion window.

    `points[:, :3]` are those of a frame and the two before it, newest first, in world metres, the rest
    where running means of the motion put them; a lag is the way from the newest frame to such a mean.
    Positions are relative to the root on the ground plane and turned by the inverse heading; gravity's
    direction and the height stay. Velocities are true world velocities, so a spin or a walk remains
    visible, resolved along `axes` (columns, world) and cut at SPEED_LIMIT; lags likewise at LAG_LIMIT.
    `cells` are flat grid indices of the points; other cells are zero.
    """
    ground = roots * roots.new_tensor([1.0, 0.0, 1.0])
    rate = fps / REFERENCE_FPS
    position = (points[:, 0] - ground[:, None]) @ headings
    velocity_now = limit_norm((points[:, 0] - points[:, 1]) * rate, SPEED_LIMIT)
    velocity_before = limit_norm((points[:, 1] - points[:, 2]) * rate, SPEED_LIMIT)
    channels = [position]
    if velocity:
        channels.append(_resolve(velocity_now, axes))
    if acceleration:
        channels.append(_resolve((velocity_now - velocity_before) * rate, axes))
    for mean in points[:, 3:].unbind(1):
        channels.append(_resolve(limit_norm(mean - points[:, 0], LAG_LIMIT), axes))
    values = torch.cat([*channels, velocity_now.norm(dim=-1, keepdim=True)], -1)
    grid = values.new_zeros(len(values), values.shape[-1], size[0] * size[1])
    grid[:, :, cells] = values.transpose(1, 2)
    grid = grid.reshape(len(values), -1, *size)
    return InputMaps(grid[:, :-1], grid[:, -1:])
