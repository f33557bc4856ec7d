"""The left-right symmetry of bodies and cloth: a mirrored motion deforms the mirrored places alike.

The mirror is the plane x = 0, of rest and of the world. A person's looks are not symmetric, so only
what the network sees and predicts is mirrored: it learns from twice the motions, and the images stay.
"""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from dsar.body.model import JOINT_NAMES
from dsar.network import NetworkOutput

_FLIP = torch.tensor([-1.0, 1.0, 1.0])
_SIDES = {"left": "right", "right": "left"}
_ROTATION = slice(0, 4)
"""Channels of the appearance residual without a mirror image: each texel's quaternion has axes of its own."""


def mirror_motion(transforms: Float[Tensor, "*f j 4 4"]) -> Float[Tensor, "*f j 4 4"]:
    """Return the mirrored motion: each joint moves as its counterpart, reflected."""
    flip = torch.cat([_FLIP, torch.ones(1)]).to(transforms)
    return flip[:, None] * transforms[..., _counterparts(), :, :] * flip


class Mirror:
    """The mirror images of an avatar's outputs."""

    def __init__(
        self, points: Float[Tensor, "p 3"], axes: Float[Tensor, "p 3 3"], cells: Int64[Tensor, " p"]
    ) -> None:
        """Pair each control point with the one nearest to its mirror image.

        Args:
            points: Control points at rest, metres.
            axes: The axes of their offsets as columns.
            cells: Their flat grid indices.
        """
        flip = _FLIP.to(points)
        nearest = [torch.cdist(some, points).argmin(1) for some in (points * flip).split(1024)]
        counterpart = torch.cat(nearest)
        self._here, self._there = cells, cells[counterpart]
        self._turn = axes.mT @ (flip[:, None] * axes[counterpart])

    def offset(self, offset: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
        """Return mirrored offset maps."""
        flat = offset.flatten(2)
        moved = self._turn @ flat[:, :, self._there].transpose(1, 2)[..., None]
        return flat.index_copy(2, self._here, moved[..., 0].transpose(1, 2)).view_as(offset)

    def undo(self, output: NetworkOutput, which: Bool[Tensor, " b"]) -> NetworkOutput:
        """Turn the answers of some rollouts, given to mirrored motions, into those to the motions.

        Changes of rotation are dropped from them, and features are as they were.
        """
        looks = output.appearance.flatten(2)
        other = looks[:, :, self._there]
        other = torch.cat([torch.zeros_like(other[:, _ROTATION]), other[:, _ROTATION.stop :]], 1)
        appearance = looks.index_copy(2, self._here, other).view_as(output.appearance)
        where = which[:, None, None, None]
        offset = torch.where(where, self.offset(output.offset), output.offset)
        return NetworkOutput(offset, torch.where(where, appearance, output.appearance), output.features)


def _counterparts() -> list[int]:
    """Return the index of each joint's counterpart on the other side of the body."""
    names = ("_".join(_SIDES.get(part, part) for part in name.split("_")) for name in JOINT_NAMES)
    return [JOINT_NAMES.index(name) for name in names]
