"""The atlas: a grid of texels over the body's surface, one Gaussian per covered texel.

Row 0 is the top of the texture (v = 1). A texel is covered where its centre lies in a UV triangle.
A garment chart, where there is one, lies in rows of its own below the body's square.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from dsar.errors import BodyError
from dsar.types import Body


@dataclass(frozen=True)
class Chart:
    """A rectangle of the atlas whose texels lie somewhere on or off the body at rest."""

    covered: Bool[Tensor, "h w"]
    """Texels that carry a Gaussian."""
    positions: Float[Tensor, "n 3"]
    """Rest positions of the covered texels in row-major order, metres."""
    weights: Float[Tensor, "n j"]
    """Skin weights of the covered texels; rows sum to 1."""
    frames: Float[Tensor, "n 3 3"]
    """Rest axes of the surface at each texel, as columns: side, up along the surface, outward normal."""
    tangents: Float[Tensor, "n 3 2"]
    """Rest displacement in metres, as columns, for one texel to the right and for one down."""


@dataclass(frozen=True)
class Atlas:
    """Charts stacked from top to bottom."""

    height: int
    """Texel rows of all charts together."""
    width: int
    """Texel columns."""
    texels: Int64[Tensor, " n"]
    """Row-major grid index of each Gaussian, ascending."""
    positions: Float[Tensor, "n 3"]
    """Rest position of each texel, metres."""
    weights: Float[Tensor, "n j"]
    """Skin weights of each texel."""
    frames: Float[Tensor, "n 3 3"]
    """Rest axes of the surface at each texel (see `Chart`)."""
    tangents: Float[Tensor, "n 3 2"]
    """Rest displacement of one texel's step along each side (see `Chart`)."""
    hidden: Bool[Tensor, " n"]
    """Texels of the body beneath a garment chart: no camera sees them at rest."""

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.texels)

    @classmethod
    def stack(cls, charts: list[Chart], hidden: Bool[Tensor, " b"] | None = None) -> "Atlas":
        """Stack charts of equal width; `hidden` marks texels of the first one, none where it is left out."""
        count = sum(len(chart.positions) for chart in charts)
        marked = torch.zeros(count, dtype=torch.bool)
        if hidden is not None:
            marked[: len(hidden)] = hidden
        covered = torch.cat([chart.covered for chart in charts])
        return cls(
            height=covered.shape[0],
            width=covered.shape[1],
            texels=covered.flatten().nonzero().squeeze(1),
            positions=torch.cat([chart.positions for chart in charts]),
            weights=torch.cat([chart.weights for chart in charts]),
            frames=torch.cat([chart.frames for chart in charts]),
            tangents=torch.cat([chart.tangents for chart in charts]),
            hidden=marked,
        )


def body_chart(body: Body, resolution: int, smoothing_rounds: int = 0) -> Chart:
    """Return the chart of the body's own UV map at resolution x resolution texels.

    Positions and skin weights are barycentric in the UV triangle of the texel. `smoothing_rounds`
    of Laplacian smoothing over the mesh soften the weights first, which loose cloth on body texels
    needs (Santesteban et al. 2021 use 50-100 for skirts).

    Raises:
        BodyError: the UV map covers no texel.
    """
    faces, barycentrics = rasterize_uv(body, resolution)
    covered = faces >= 0
    if not covered.any():
        raise BodyError(
            f"the body's UV map covers none of {resolution}x{resolution} texels; is it in [0, 1]?"
        )
    corners = body.faces[faces[covered]]
    mix = barycentrics[covered]
    weights = smooth_weights(body, smoothing_rounds)
    return Chart(
        covered=covered,
        positions=torch.einsum("nk,nkc->nc", mix, body.vertices[corners]),
        weights=torch.einsum("nk,nkj->nj", mix, weights[corners]),
        frames=surface_frames(torch.einsum("nk,nkc->nc", mix, vertex_normals(body)[corners])),
        tangents=uv_tangents(body, resolution)[faces[covered]],
    )


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
