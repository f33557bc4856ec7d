"""The left-right symmetry of bodies and cloth: a mirrored motion deforms the mirrored places alike.

The mirror is the plane x = 0, of rest and of the world. A person's looks are not symmetric, so only
what the network sees and predicts is mirrored: it learns from twice the motions, and the images stay.
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from dsar.body.model import JOINT_NAMES
from dsar.network import NetworkOutput

_FLIP = torch.tensor([-1.0, 1.0, 1.0])
_SIDES = {"left": "right", "right": "left"}
_ROTATION = slice(0, 4)
"""Channels of the appearance residual without a mirror image: each texel's quaternion has axes of its own."""


def mirror_track(track: Float[Tensor, "f j 4 4"]) -> Float[Tensor, "f j 4 4"]:
    """Return the mirrored motion of a track: each joint moves as its counterpart, reflected."""
    flip = torch.cat([_FLIP, torch.ones(1)]).to(track)
    return flip[:, None] * track[:, _counterparts()] * flip


def mirror_cells(
    points: Float[Tensor, "p 3"], axes: Float[Tensor, "p 3 3"]
) -> tuple[Int64[Tensor, " p"], Float[Tensor, "p 3 3"]]:
    """Return each control point's counterpart and the matrix that takes the counterpart's offset there.

    Args:
        points: Control points at rest, metres.
        axes: The axes of their offsets as columns.
    """
    flip = _FLIP.to(points)
    counterpart = torch.cdist(points * flip, points).argmin(1)
    return counterpart, axes.mT @ (flip[:, None] * axes[counterpart])


def mirror_output(
    output: NetworkOutput,
    cells: Int64[Tensor, " p"],
    mirror: tuple[Int64[Tensor, " p"], Float[Tensor, "p 3 3"]],
) -> NetworkOutput:
    """Return what the output to a mirrored motion says of the motion itself, without features.

    Args:
        output: The network's output; a change of rotation is dropped.
        cells: Flat grid indices of the control points.
        mirror: What `mirror_cells` returned.
    """
    appearance = output.appearance.flatten(2)
    look = appearance[:, :, cells[mirror[0]]]
    appearance = appearance.index_copy(2, cells, torch.cat([0 * look[:, _ROTATION], look[:, 4:]], 1))
    offset = mirror_offset(output.offset, cells, mirror)
    return NetworkOutput(offset, appearance.view_as(output.appearance), ())


def mirror_offset(
    offset: Float[Tensor, "b 3 h w"],
    cells: Int64[Tensor, " p"],
    mirror: tuple[Int64[Tensor, " p"], Float[Tensor, "p 3 3"]],
) -> Float[Tensor, "b 3 h w"]:
    """Return mirrored offset maps; see `mirror_output`."""
    counterpart, turn = mirror
    flat = offset.flatten(2)
    there = flat[:, :, cells[counterpart]].transpose(1, 2)
    flat = flat.index_copy(2, cells, (turn @ there[..., None])[..., 0].transpose(1, 2))
    return flat.view_as(offset)


def _counterparts() -> list[int]:
    """Return the index of each joint's counterpart on the other side of the body."""
    names = ("_".join(_SIDES.get(part, part) for part in name.split("_")) for name in JOINT_NAMES)
    return [JOINT_NAMES.index(name) for name in names]
