"""The garment at rest: the surface that the template learns, and how it hangs in each still frame.

Cloth never comes to rest twice in the same folds. A template fitted to several still frames at once would
blur what they differ in; so each of them has offsets of its own, and the template is what they share
(extension).
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from dsar.avatar.avatar import Avatar
from dsar.avatar.control_grid import find_surface_edges
from dsar.config import LossConfig
from dsar.network import NetworkOutput
from dsar.training.losses import CENTIMETRES, spatial_loss

PULL = 1e-4
"""Weight of the squared offset, cm: what all frames share is the template's."""


class RestOffsets(nn.Module):
    """Offsets of the garment in each still frame; empty where there is no garment."""

    def __init__(self, avatar: Avatar, frames: list[tuple[str, int]]) -> None:
        super().__init__()
        self.frames = frames
        """Sequence and frame of each shape."""
        shape = len(frames), len(avatar.garment_control_points()), 3
        self.offsets = nn.Parameter(avatar.texel_positions.new_zeros(shape))
        """Offsets of the garment's control points along their axes, metres."""
        self._garment = avatar.garment_texels()
        self._chart = avatar.texel_positions[self._garment]
        cells = avatar.texels[self._garment]
        self._edges = find_surface_edges(cells, avatar.atlas_size, self._chart, avatar.charts)

    def output(self, avatar: Avatar, frames: Int64[Tensor, " b"]) -> NetworkOutput:
        """Return the output that gives the garment the shapes it has in some of the frames."""
        return avatar.offset_garment(self.offsets.index_select(0, frames))

    def earliest(self, sequence: str) -> Float[Tensor, "g 3"]:
        """Return the offsets in the earliest still frame of a sequence, zeros if it has none."""
        frames = [(frame, index) for index, (name, frame) in enumerate(self.frames) if name == sequence]
        if not frames:
            return torch.zeros_like(self.offsets[0])
        return self.offsets[min(frames)[1]].detach().clone()

    def loss(self, avatar: Avatar, config: LossConfig) -> Float[Tensor, ""]:
        """Return what keeps the cloth in one piece: neighbours move together, in the template and off it."""
        if not len(self._garment):
            return self.offsets.new_zeros(())
        moved = (avatar.template.means[self._garment] - self._chart)[None]
        together = spatial_loss(avatar.scatter_garment_points(self.offsets), avatar.control.edges)
        pull = (self.offsets * CENTIMETRES).square().sum(-1).mean()
        return config.shape * spatial_loss(moved, self._edges) + config.spatial * together + PULL * pull
