"""The body as the simulated cloth meets it: some points of its skin with their tangent planes."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Int64
from numpy import ndarray
from torch import Tensor

from dsar.body.model import JOINT_NAMES
from dsar.body.skinning import blend_transforms
from dsar.body.uv_map import vertex_normals
from dsar.types import Body

SPACING, HAND_SPACING = 0.035, 0.05
"""Metres between neighbouring points, on trunk and legs and on hands."""
ABOVE, BELOW = 0.12, 0.10
"""Metres above the garment's upper edge and below its hem that the collider reaches at rest."""
_NEIGHBOURS = 12
_ARMS = ("collar", "shoulder", "elbow", "wrist")
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")


class BodyCollider:
    """Points of trunk, legs and hands around a garment, made once for a body."""

    def __init__(self, body: Body, top: float, hem: float) -> None:
        """Take points of a resting body around a garment.

        Args:
            body: In its rest pose.
            top: Height of the garment's upper edge at rest, metres.
            hem: Height of its lower edge.
        """
        weights = _without_fingers(body.weights)
        arms = weights[:, _joints(_ARMS)].sum(1) > 0.5
        hands = weights[:, _joints(("wrist",))].sum(1) > 0.5
        height = body.vertices[:, 1]
        near = (height < top + ABOVE) & (height > hem - BELOW) & ~arms
        index = torch.cat(
            [
                _thin_out(body.vertices, near, SPACING),
                _thin_out(body.vertices, hands & ~near, HAND_SPACING),
            ]
        )
        used = (weights[index] > 1e-3).any(0).nonzero().squeeze(1)
        self.joints: Int64[Tensor, " u"] = used
        """Joints that carry any of the points."""
        carried = weights[index][:, used]
        self.weights: Float[Tensor, "b u"] = carried / carried.sum(1, keepdim=True)
        """Skin weights over these joints."""
        self.points: Float[Tensor, "b 3"] = body.vertices[index]
        """Rest positions, metres."""
        self.normals: Float[Tensor, "b 3"] = vertex_normals(body)[index]
        """Outward unit normals at rest."""
        distances = torch.cdist(self.points, self.points)
        count = min(_NEIGHBOURS + 1, len(index))
        nearest = distances.topk(count, largest=False).indices[:, 1:]
        self.neighbours: Int32[ndarray, "b k"] = nearest.int().numpy()
        """Points around each, between which the nearest to a point of cloth is looked for."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)

    def pose(
        self, transforms: Float[Tensor, "f j 4 4"]
    ) -> tuple[Float[Tensor, "f b 3"], Float[Tensor, "f b 3"]]:
        """Return the points, world metres, and their unit normals where T_world_rest of joints carry them."""
        blended = blend_transforms(self.weights, transforms[:, self.joints])
        points = (blended[..., :3] * self.points[:, None]).sum(-1) + blended[..., 3]
        normals = (blended[..., :3] * self.normals[:, None]).sum(-1)
        return points, torch.nn.functional.normalize(normals, dim=-1)


def _without_fingers(weights: Float[Tensor, "v j"]) -> Float[Tensor, "v j"]:
    """Return skin weights in which fingers move with their hand."""
    merged = weights.clone()
    for side in ("left", "right"):
        fingers = _joints(tuple(f"{side}_{finger}" for finger in _FINGERS))
        merged[:, JOINT_NAMES.index(f"{side}_wrist")] += merged[:, fingers].sum(1)
        merged[:, fingers] = 0
    return merged


def _joints(parts: tuple[str, ...]) -> Bool[Tensor, " j"]:
    return torch.tensor([any(part in name for part in parts) for name in JOINT_NAMES])


def _thin_out(
    points: Float[Tensor, "v 3"], wanted: Bool[Tensor, " v"], spacing: float
) -> Int64[Tensor, " b"]:
    """Return the first of the wanted points in every cell of a grid."""
    index = wanted.nonzero().squeeze(1)
    cells = torch.floor(points[index] / spacing).long().numpy()
    _, first = np.unique(cells, axis=0, return_index=True)
    return index[torch.from_numpy(np.sort(first))]
