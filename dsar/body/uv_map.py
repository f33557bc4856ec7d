"""The body's UV map: which face lies under each texel, and what varies over the surface.

Row 0 is the top of the texture (v = 1). A texel is covered where its centre lies in a UV triangle.
"""

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from dsar.types import Body


def uv_tangents(body: Body, resolution: int) -> Float[Tensor, "f 3 2"]:
    """Return each face's displacement in metres for one texel to the right and one down its UV map.

    Faces that the UV map folds to nothing get zero; no texel's centre lies in them.
    """
    corners = body.vertices[body.faces].double()
    uv = body.uv[body.uv_faces].double() * torch.tensor([resolution, -resolution])
    edges = (corners[:, 1:] - corners[:, :1]).transpose(1, 2)
    texels = (uv[:, 1:] - uv[:, :1]).transpose(1, 2)
    flat = torch.linalg.det(texels).abs() < 1e-12
    texels[flat] = torch.eye(2, dtype=texels.dtype)
    edges[flat] = 0
    return torch.linalg.solve(texels, edges, left=False).float()


def vertex_normals(body: Body) -> Float[Tensor, "v 3"]:
    """Return outward unit normals of the resting body, faces weighted by area."""
    a, b, c = body.vertices[body.faces].unbind(1)
    normals = torch.linalg.cross(b - a, c - a)
    summed = torch.zeros_like(body.vertices)
    for corner in range(3):
        summed.index_add_(0, body.faces[:, corner], normals)
    return torch.nn.functional.normalize(summed, dim=-1)


def surface_frames(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """Return right-handed axes (columns side, up, normal); where the surface is level, up is the front."""
    normals = torch.nn.functional.normalize(normals, dim=-1)
    level = normals[:, 1:2].abs() > 0.95
    up = torch.where(level, normals.new_tensor([0.0, 0.0, 1.0]), normals.new_tensor([0.0, 1.0, 0.0]))
    up = torch.nn.functional.normalize(up - (up * normals).sum(-1, keepdim=True) * normals, dim=-1)
    return torch.stack([torch.linalg.cross(up, normals), up, normals], -1)


def rasterize_uv(body: Body, resolution: int) -> tuple[Int64[Tensor, "r r"], Float[Tensor, "r r 3"]]:
    """Return the face under each texel centre (-1: none) and the barycentrics of the centre in it."""
    corners = body.uv[body.uv_faces].double().numpy() * resolution
    corners[..., 1] = resolution - corners[..., 1]
    faces = np.full((resolution, resolution), -1, np.int64)
    barycentrics = np.zeros((resolution, resolution, 3))
    low = np.clip(np.ceil(corners.min(1) - 0.5), 0, resolution).astype(int)
    high = np.clip(np.floor(corners.max(1) - 0.5) + 1, 0, resolution).astype(int)
    for face in np.flatnonzero((high > low).all(1)):
        (x0, y0), (x1, y1) = low[face], high[face]
        a, b, c = corners[face]
        edges = np.array([b - a, c - a]).T
        if abs(np.linalg.det(edges)) < 1e-12:
            continue
        centers = np.stack(np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5), -1)
        st = (centers - a) @ np.linalg.inv(edges).T
        weights = np.concatenate([1 - st.sum(-1, keepdims=True), st], -1)
        inside = (weights >= -1e-9).all(-1)
        faces[y0:y1, x0:x1][inside] = face
        barycentrics[y0:y1, x0:x1][inside] = weights[inside]
    return torch.from_numpy(faces), torch.from_numpy(barycentrics).float()


def smooth_weights(body: Body, rounds: int) -> Float[Tensor, "v j"]:
    """Return skin weights after rounds of averaging over mesh neighbours; rows still sum to 1."""
    weights = body.weights
    if rounds == 0:
        return weights
    edges = torch.cat([body.faces[:, [i, j]] for i in range(3) for j in range(3) if i != j]).unique(dim=0)
    degree = torch.bincount(edges[:, 0], minlength=len(weights)).clamp_min(1)
    for _ in range(rounds):
        mean = torch.zeros_like(weights).index_add_(0, edges[:, 0], weights[edges[:, 1]])
        weights = 0.5 * (weights + mean / degree[:, None])
    return weights / weights.sum(1, keepdim=True)
