"""A chart of the atlas for loose cloth, fitted to the visual hull where it stands off the body.

On bare skin texels a skirt tears into shorts when the legs part; a closed tube of texels from the
waist to the hem, carried by heavily smoothed skin weights, does not.
"""

import logging
import math

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from dsar.avatar.charts import ChartTexels
from dsar.body.model import JOINT_NAMES
from dsar.body.uv_map import surface_frames
from dsar.geometry.cameras import project
from dsar.types import Body, Capture

LOGGER = logging.getLogger(__name__)

LOOSE_GAP = 0.03
"""Metres by which a hull must stand off the body, in the median over azimuth, to count as loose."""
MIN_LENGTH = 0.10
"""Metres of loose height below which no chart is worth having."""
SEARCH_STEP = 0.0125
"""Metres between samples along a radius and between heights."""
SEARCH_RADIUS = 0.7
"""Metres from the body's axis that the search covers."""
AZIMUTHS = 64
"""Directions sampled around the axis."""
BELOW_HEM = 0.03
"""Metres below the hem that still count as beneath the garment: cameras above the hem do not see them."""
PAST_HEM = 2 * SEARCH_STEP
"""Metres by which the chart goes on below the hem that is seen."""
_ARMS = ("collar", "shoulder", "elbow", "wrist", "index", "middle", "pinky", "ring", "thumb")


def fit_garment_chart(
    body: Body,
    capture: Capture,
    frames: list[tuple[str, int]],
    pelvis: Float[Tensor, "f 4 4"],
    size: tuple[int, int],
    smoothing: float,
) -> ChartTexels | None:
    """Return a tube of size (rows, columns) around the loose garment, or None where there is none.

    `frames` should be still; `pelvis` is T_world_rest of the pelvis in each. Columns go once around, from
    the back over the right side, the front and the left side to the back; rows from waist to hem.
    """
    heights = torch.arange(float(body.joints[JOINT_NAMES.index("left_ankle"), 1]), _chest(body), SEARCH_STEP)
    hull = hull_radii(capture, frames, pelvis, body.joints[0], heights)
    gap = hull - body_radii(body, heights)
    extent = loose_extent(heights, gap.median(1).values)
    if extent is None:
        LOGGER.info("no loose garment found: the atlas is the body's alone")
        return None
    hem, waist = extent
    # The masks of all cameras agree on a little less than the cloth: its border must not be left to the legs.
    rows = torch.linspace(waist, hem - PAST_HEM, size[0])
    azimuths = _azimuths(size[1])
    # Near the hem the masks' border frays the hull; the cloth goes straight on there.
    radii = _resample(hull, heights, rows.clamp_min(hem + 4 * SEARCH_STEP), size[1])
    directions = torch.stack([azimuths.sin(), torch.zeros_like(azimuths), azimuths.cos()], -1)
    axis = torch.stack([body.joints[0, 0].expand(size[0]), rows, body.joints[0, 2].expand(size[0])], -1)
    positions = (axis[:, None] + radii[..., None] * directions).reshape(-1, 3)
    LOGGER.info(
        "loose garment found: %.2f m from waist to hem, mean hem radius %.2f m", waist - hem, radii[-1].mean()
    )
    weights = diffuse_weights(body, positions, smoothing)
    axes = surface_frames(directions.repeat(size[0], 1))
    tangents = tube_tangents(positions.unflatten(0, size))
    covered = torch.ones(size, dtype=torch.bool)
    return ChartTexels("garment", "tube", covered, positions, weights, axes, tangents)


def tube_tangents(positions: Float[Tensor, "r c 3"]) -> Float[Tensor, "n 3 2"]:
    """Return a tube's displacement for one texel to the right, where columns close, and for one down."""
    right = (positions.roll(-1, 1) - positions.roll(1, 1)) / 2
    down = torch.gradient(positions, dim=0)[0]
    return torch.stack([right, down], -1).flatten(0, 1)


def tube_faces(rows: int, columns: int) -> Int64[Tensor, "t 3"]:
    """Return the triangles between a tube's texels in row-major order, counter-clockwise from outside."""
    index = torch.arange(rows * columns).unflatten(0, (rows, columns))
    upper, lower = index[:-1], index[1:]
    after, beneath = upper.roll(-1, 1), lower.roll(-1, 1)
    halves = torch.stack([upper, lower, after], -1), torch.stack([after, lower, beneath], -1)
    return torch.cat([half.reshape(-1, 3) for half in halves])


def texels_beneath(body: Body, chart: ChartTexels, points: ChartTexels) -> Bool[Tensor, " n"]:
    """Return which texels of the body's chart lie inside a garment's tube at rest; arms never do."""
    center = body.joints[0]
    offset, tube = points.positions - center, (chart.positions - center).unflatten(0, chart.covered.shape)
    rows, columns = chart.covered.shape
    waist, hem = tube[0, 0, 1], tube[-1, 0, 1]
    row = ((waist - offset[:, 1]) / (waist - hem) * (rows - 1)).round().long().clamp(0, rows - 1)
    azimuth = torch.atan2(offset[:, 0], offset[:, 2])
    column = ((azimuth + math.pi) / (2 * math.pi) * columns).long().clamp(0, columns - 1)
    inside = offset[:, [0, 2]].norm(dim=1) < tube[row, column][:, [0, 2]].norm(dim=1)
    level = (offset[:, 1] <= waist) & (offset[:, 1] >= hem - BELOW_HEM)
    return inside & level & (points.weights[:, arm_joints()].sum(1) < 0.5)


def hull_radii(
    capture: Capture,
    frames: list[tuple[str, int]],
    pelvis: Float[Tensor, "f 4 4"],
    center: Float[Tensor, "3"],
    heights: Float[Tensor, " y"],
) -> Float[Tensor, "y a"]:
    """Return how far the visual hull reaches from the pelvis axis per height and azimuth, metres.

    Of all frames the lower quartile is taken: arms and swinging cloth come and go, cloth at rest stays.
    """
    azimuths = _azimuths(AZIMUTHS)
    radii = torch.arange(0.0, SEARCH_RADIUS, SEARCH_STEP)
    directions = torch.stack([azimuths.sin(), torch.zeros_like(azimuths), azimuths.cos()], -1)
    axis = torch.stack([center[0].expand(len(heights)), heights, center[2].expand(len(heights))], -1)
    samples = axis[:, None, None] + radii[:, None] * directions[None, :, None]
    extents = []
    for (sequence, frame), transform in zip(frames, pelvis, strict=True):
        world = samples @ transform[:3, :3].T + transform[:3, 3]
        inside = torch.ones(world.shape[:-1], dtype=torch.bool)
        for index in capture.cameras_with_image(sequence, frame):
            camera = capture.cameras[index]
            mask = torch.from_numpy(capture.image(sequence, frame, index)[..., 3] > 127)
            pixels, depth = project(camera, world)
            inside &= _sample_mask(mask, pixels) & (depth > 0)
        extents.append(inside.cumprod(-1).sum(-1) * SEARCH_STEP)
    return torch.stack(extents).quantile(0.25, dim=0)


def body_radii(body: Body, heights: Float[Tensor, " y"]) -> Float[Tensor, "y a"]:
    """Return how far the resting body, without its arms, reaches from the pelvis axis, metres."""
    vertices = body.vertices[~_is_arm(body)]
    offset = vertices - body.joints[0]
    azimuth = torch.atan2(offset[:, 0], offset[:, 2])
    column = ((azimuth + math.pi) / (2 * math.pi) * AZIMUTHS).long().clamp(0, AZIMUTHS - 1)
    distance = offset[:, [0, 2]].norm(dim=1)
    radii = torch.zeros(len(heights), AZIMUTHS)
    for row, height in enumerate(heights):
        near = (vertices[:, 1] - height).abs() < 2 * SEARCH_STEP
        radii[row].scatter_reduce_(0, column[near], distance[near], "amax")
    return radii


def loose_extent(heights: Float[Tensor, " y"], gap: Float[Tensor, " y"]) -> tuple[float, float] | None:
    """Return (hem, waist) of the longest loose run of heights, the waist where the gap ends."""
    loose = (gap > LOOSE_GAP).tolist()
    runs, start = [], None
    for i, flag in enumerate([*loose, False]):
        if flag and start is None:
            start = i
        if not flag and start is not None:
            runs.append((start, i - 1))
            start = None
    if not runs:
        return None
    low, high = max(runs, key=lambda run: run[1] - run[0])
    if float(heights[high] - heights[low]) < MIN_LENGTH:
        return None
    while high + 1 < len(gap) and gap[high + 1] > LOOSE_GAP / 3 and gap[high + 1] <= gap[high]:
        high += 1
    return float(heights[low]), float(heights[high])


def diffuse_weights(body: Body, points: Float[Tensor, "n 3"], sigma: float) -> Float[Tensor, "n j"]:
    """Return skin weights of points off the body: a Gaussian-weighted mean of the body's, arms left out.

    `sigma` in metres says how far a thigh's pull spreads over the cloth.
    """
    keep = ~_is_arm(body)
    vertices, weights = body.vertices[keep], body.weights[keep]
    squared = torch.cdist(points, vertices).square()
    nearest = squared.amin(1, keepdim=True)
    kernel = torch.exp((nearest - squared) / (2 * max(sigma, 1e-3) ** 2))
    blended = kernel @ weights
    return blended / blended.sum(1, keepdim=True)


def _is_arm(body: Body) -> Bool[Tensor, " v"]:
    return body.weights[:, arm_joints()].sum(1) > 0.5


def arm_joints() -> Bool[Tensor, " j"]:
    """Return which joints move an arm or a hand."""
    return torch.tensor([any(part in name for part in _ARMS) for name in JOINT_NAMES])


def _chest(body: Body) -> float:
    return float(body.joints[JOINT_NAMES.index("spine2"), 1])


def _azimuths(count: int) -> Float[Tensor, " a"]:
    """Return bin centres from the back (-pi) over -X, the front (0) and +X to the back again."""
    return (torch.arange(count) + 0.5) / count * 2 * math.pi - math.pi


def _sample_mask(mask: Bool[Tensor, "h w"], pixels: Float[Tensor, "*b 2"]) -> Bool[Tensor, " *b"]:
    h, w = mask.shape
    x, y = pixels[..., 0].floor().long(), pixels[..., 1].floor().long()
    valid = (x >= 0) & (x < w) & (y >= 0) & (y < h)
    return mask[y.clamp(0, h - 1), x.clamp(0, w - 1)] & valid


def _resample(
    hull: Float[Tensor, "y a"], heights: Float[Tensor, " y"], rows: Float[Tensor, " r"], columns: int
) -> Float[Tensor, "r c"]:
    """Return the hull at the chart's rows and columns, smoothed over azimuth and height."""
    span = (rows - heights[0]) / (heights[-1] - heights[0]) * 2 - 1
    wrapped = torch.cat([hull[:, -4:], hull, hull[:, :4]], 1)
    smooth = torch.nn.functional.avg_pool2d(wrapped[None, None], (5, 5), 1, (2, 2), count_include_pad=False)
    # Columns in units of the wrapped grid's pixels, then in grid_sample's [-1, 1].
    column = (torch.arange(columns) + 0.5) / columns * AZIMUTHS + 4
    across = column / (AZIMUTHS + 8) * 2 - 1
    grid = torch.stack(torch.meshgrid(span, across, indexing="ij"), -1).flip(-1)
    height_scale = (len(heights) - 1) / len(heights)
    grid = grid * grid.new_tensor([1.0, height_scale])
    return torch.nn.functional.grid_sample(smooth, grid[None], align_corners=False)[0, 0]
