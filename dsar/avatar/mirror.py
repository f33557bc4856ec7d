"""The left-right symmetry of bodies and cloth: a mirrored motion deforms the mirrored places alike.

The mirror is the plane x = 0, of rest and of the world. A person's appearance is not symmetric, so only
what the network sees and predicts is mirrored: it learns from twice the motions, and the images stay.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dsar.avatar.control_grid import ControlGrid
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

    def __init__(self, control: ControlGrid) -> None:
        """Pair each control point with the one of its chart nearest to its mirror image."""
        points, axes, cells = control.points, control.axes, control.cells
        flip = _FLIP.to(points)
        counterpart = torch.empty_like(cells)
        for chart in control.charts:
            own = control.on_charts([chart])
            nearest = [
                torch.cdist(chunk, points[own]).argmin(1) for chunk in (points[own] * flip).split(1024)
            ]
            counterpart[own] = own[torch.cat(nearest)] if len(own) else own
        self._cells, self._counterpart, self._counterpart_cells = cells, counterpart, cells[counterpart]
        self._change_of_axes = axes.mT @ (flip[:, None] * axes[counterpart])

    def mirror_offset(self, offset: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
        """Return mirrored offset maps."""
        flat = offset.flatten(2)
        moved = self._change_of_axes @ flat[:, :, self._counterpart_cells].transpose(1, 2)[..., None]
        return flat.index_copy(2, self._cells, moved[..., 0].transpose(1, 2)).view_as(offset)

    def mirror_cloth(
        self, cloth: Float[Tensor, "b g 6"], which: Bool[Tensor, " b"]
    ) -> Float[Tensor, "b g 6"]:
        """Return the motion prior with the rollouts in `which` mirrored; the last control points are its."""
        points = cloth.shape[1]
        counterparts = self._counterpart[-points:] - (len(self._counterpart) - points)
        values = cloth[:, counterparts].unflatten(-1, (2, 3))
        mirrored = (self._change_of_axes[-points:, None] @ values[..., None])[..., 0].flatten(-2)
        return torch.where(which[:, None, None], mirrored, cloth)

    def unmirror(self, output: NetworkOutput, which: Bool[Tensor, " b"]) -> NetworkOutput:
        """Turn the outputs of the rollouts in `which`, made from mirrored motions, into those of the motions.

        Changes of rotation are dropped from them, and features are as they were.
        """
        residuals = output.appearance.flatten(2)
        mirrored = residuals[:, :, self._counterpart_cells]
        mirrored = torch.cat([torch.zeros_like(mirrored[:, _ROTATION]), mirrored[:, _ROTATION.stop :]], 1)
        appearance = residuals.index_copy(2, self._cells, mirrored).view_as(output.appearance)
        where = which[:, None, None, None]
        offset = torch.where(where, self.mirror_offset(output.offset), output.offset)
        return NetworkOutput(offset, torch.where(where, appearance, output.appearance), output.features)


def _counterparts() -> list[int]:
    """Return the index of each joint's counterpart on the other side of the body."""
    names = ("_".join(_SIDES.get(part, part) for part in name.split("_")) for name in JOINT_NAMES)
    return [JOINT_NAMES.index(name) for name in names]
