"""The atlas: charts of texels on the body and around its loose garments, one Gaussian per covered texel.

Charts lie below each other and are as wide as the atlas. The first is the body's own UV map: islands in a
square. Below it lies a tube for each loose garment. Row 0 is the top of the body's texture (v = 1).
"""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from dsar.body.uv_map import rasterize_uv, smooth_weights, surface_frames, uv_tangents, vertex_normals
from dsar.errors import BodyError
from dsar.types import Body

Topology = Literal["island", "tube"]
"""`island`: the chart ends at all four sides. `tube`: its first column follows its last."""


@dataclass(frozen=True)
class Chart:
    """A named part of the atlas: all columns of some rows."""

    name: str
    """What lies on it, such as `body` or `garment`."""
    topology: Topology
    """How its columns join."""
    rows: range
    """Rows of the atlas, or of a map with fewer rows."""

    def downsampled(self, factor: int) -> "Chart":
        """Return the same part of a map with one row for every `factor` rows of the atlas."""
        return dataclasses.replace(self, rows=range(self.rows.start // factor, self.rows.stop // factor))

    def holds(self, rows: Int64[Tensor, " n"]) -> Bool[Tensor, " n"]:
        """Return which rows are the chart's."""
        return (rows >= self.rows.start) & (rows < self.rows.stop)


@dataclass(frozen=True)
class ChartTexels:
    """What lies on a chart: texels somewhere on or off the body at rest."""

    name: str
    """Name of the chart."""
    topology: Topology
    """How its columns join."""
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
    """Charts stacked from top to bottom, and the texels of all."""

    charts: tuple[Chart, ...]
    """From top to bottom; the first is the body's."""
    width: int
    """Texel columns."""
    texels: Int64[Tensor, " n"]
    """Row-major grid index of each Gaussian, ascending."""
    positions: Float[Tensor, "n 3"]
    """Rest position of each texel, metres."""
    weights: Float[Tensor, "n j"]
    """Skin weights of each texel."""
    frames: Float[Tensor, "n 3 3"]
    """Rest axes of the surface at each texel (see `ChartTexels`)."""
    tangents: Float[Tensor, "n 3 2"]
    """Rest displacement of one texel's step along each side (see `ChartTexels`)."""
    hidden: Bool[Tensor, " n"]
    """Texels of the body beneath a garment: no camera sees them at rest."""

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.texels)

    @property
    def height(self) -> int:
        """Texel rows of all charts together."""
        return self.charts[-1].rows.stop

    @classmethod
    def stack(cls, charts: Sequence[ChartTexels], hidden: Bool[Tensor, " b"] | None = None) -> "Atlas":
        """Stack charts of equal width; `hidden` marks texels of the first one, none where it is left out."""
        count = sum(len(chart.positions) for chart in charts)
        marked = torch.zeros(count, dtype=torch.bool)
        if hidden is not None:
            marked[: len(hidden)] = hidden
        placed: list[Chart] = []
        for chart in charts:
            start = placed[-1].rows.stop if placed else 0
            placed.append(Chart(chart.name, chart.topology, range(start, start + len(chart.covered))))
        covered = torch.cat([chart.covered for chart in charts])
        return cls(
            charts=tuple(placed),
            width=covered.shape[1],
            texels=covered.flatten().nonzero().squeeze(1),
            positions=torch.cat([chart.positions for chart in charts]),
            weights=torch.cat([chart.weights for chart in charts]),
            frames=torch.cat([chart.frames for chart in charts]),
            tangents=torch.cat([chart.tangents for chart in charts]),
            hidden=marked,
        )


def encode_charts(charts: Sequence[Chart]) -> Tensor:
    """Return charts as a tensor for a checkpoint: the bytes of their JSON."""
    records = [{"name": c.name, "topology": c.topology, "rows": [c.rows.start, c.rows.stop]} for c in charts]
    return torch.tensor(list(json.dumps(records).encode()), dtype=torch.uint8)


def decode_charts(encoded: Tensor | None, height: int, width: int) -> tuple[Chart, ...]:
    """Return the charts of a checkpoint; older ones say no more than the atlas's size in texels.

    Their first chart is the body's square, and what lies below it is one tube.

    Raises:
        ValueError: the charts are not those of an atlas of that height.
    """
    if encoded is None:
        body = Chart("body", "island", range(min(width, height)))
        return (body, Chart("garment", "tube", range(width, height))) if height > width else (body,)
    records = json.loads(bytes(encoded.tolist()))
    charts = tuple(Chart(r["name"], r["topology"], range(*r["rows"])) for r in records)
    starts, stops = [c.rows.start for c in charts], [c.rows.stop for c in charts]
    if [*starts, height] != [0, *stops]:
        raise ValueError(f"charts of rows {[[c.rows.start, c.rows.stop] for c in charts]} of {height}")
    return charts


def body_chart(body: Body, resolution: int, smoothing_rounds: int = 0) -> ChartTexels:
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
    return ChartTexels(
        name="body",
        topology="island",
        covered=covered,
        positions=torch.einsum("nk,nkc->nc", mix, body.vertices[corners]),
        weights=torch.einsum("nk,nkj->nj", mix, weights[corners]),
        frames=surface_frames(torch.einsum("nk,nkc->nc", mix, vertex_normals(body)[corners])),
        tangents=uv_tangents(body, resolution)[faces[covered]],
    )
