"""The garment's shape against the simulated truth, beside what no history and another past would give."""

import statistics

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from PIL import Image, ImageDraw
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.rollout import roll_out, template_sequence
from dsar.data.captures.multiview import MultiViewCapture
from dsar.evaluation.results import GarmentFigures
from dsar.geometry.cameras import project
from dsar.types import Camera

CLOSE = 0.02
"""Metres within which a point counts as right in the F-score."""
_CANDIDATES = 8
"""Triangles with the nearest centres among which a point's nearest is looked for."""
_UP = 1


def closest_on_triangles(
    points: Float[Tensor, "p 3"], triangles: Float[Tensor, "p 3 3"]
) -> Float[Tensor, "p 3"]:
    """Return the point of each triangle that is nearest to a point.

    The foot of the perpendicular where it is inside, else the nearest point of the three edges.
    """
    origin, u, v = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    pu, pv = ((points - origin) * u).sum(-1), ((points - origin) * v).sum(-1)
    area = (uu * vv - uv * uv).clamp_min(1e-20)
    s, t = (vv * pu - uv * pv) / area, (uu * pv - uv * pu) / area
    inside = (s >= 0) & (t >= 0) & (s + t <= 1)
    foot = origin + s[:, None] * u + t[:, None] * v
    ends = triangles.roll(-1, 1)
    along = ((points[:, None] - triangles) * (ends - triangles)).sum(-1)
    share = (along / (ends - triangles).square().sum(-1).clamp_min(1e-20)).clamp(0, 1)
    edges = triangles + share[..., None] * (ends - triangles)
    nearest = (points[:, None] - edges).square().sum(-1).argmin(1)
    return torch.where(inside[:, None], foot, edges[torch.arange(len(points)), nearest])


def distance_to_mesh(
    points: Float[Tensor, "p 3"], vertices: Float[Tensor, "v 3"], faces: Int64[Tensor, "f 3"]
) -> Float[Tensor, " p"]:
    """Return the distances of points to a mesh of triangles of similar size."""
    triangles = vertices[faces]
    count = min(_CANDIDATES, len(faces))
    near = torch.cdist(points, triangles.mean(1)).topk(count, largest=False).indices
    repeated = points.repeat_interleave(count, 0)
    closest = closest_on_triangles(repeated, triangles[near.flatten()])
    return (repeated - closest).norm(dim=-1).reshape(-1, count).amin(1)


def hem_loop(vertices: Float[Tensor, "v 3"], faces: Int64[Tensor, "f 3"]) -> Int64[Tensor, " h"]:
    """Return the vertices of the lowest border of a tube-like mesh (Y is up)."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
    unique, counts = edges.unique(dim=0, return_counts=True)
    border = unique[counts == 1]
    label = torch.arange(len(vertices))
    while True:
        lower = label[border].amin(1)
        spread = label.clone().scatter_reduce_(0, border.flatten(), lower.repeat_interleave(2), "amin")
        if torch.equal(spread, label):
            break
        label = spread
    loops = [label == name for name in label[border.flatten()].unique()]
    return min(loops, key=lambda loop: float(vertices[loop, _UP].mean())).nonzero().squeeze(1)


def measure_shape(
    points: Float[Tensor, "p 3"], vertices: Float[Tensor, "v 3"], faces: Int64[Tensor, "f 3"]
) -> dict[str, float]:
    """Return Chamfer distance (mean of both directions, metres) and F-score at CLOSE of a cloud of points."""
    there = distance_to_mesh(points, vertices, faces)
    back = torch.cdist(vertices, points).amin(1)
    precision, recall = (float((d < CLOSE).float().mean()) for d in (there, back))
    score = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    return {"chamfer": float(there.mean() + back.mean()) / 2, "fscore": score}


def measure_hem(points: Float[Tensor, "h 3"]) -> tuple[float, float]:
    """Return mean horizontal distance to the hem's centre and mean height, metres."""
    flat = points[:, [0, 2]]
    return float((flat - flat.mean(0)).norm(dim=-1).mean()), float(points[:, _UP].mean())


def measure_jitter(points: Float[Tensor, "f p 3"], fps: float) -> float:
    """Return the mean jerk of moving points, m/s³; 0 of fewer than four frames."""
    jerks = points.diff(n=3, dim=0).norm(dim=-1) * fps**3
    return float(jerks.mean()) if len(jerks) else 0.0


def garment_mask(
    vertices: Float[Tensor, "v 3"], faces: Int64[Tensor, "f 3"], camera: Camera
) -> Bool[Tensor, "h w"]:
    """Return where a mesh in world metres is in an image, whatever is in front of it."""
    pixels = project(camera, vertices)[0]
    picture = Image.new("1", (camera.width, camera.height))
    draw = ImageDraw.Draw(picture)
    # Pillow fills the pixels that hold the corners, and all between.
    for triangle in pixels[faces].floor().tolist():
        draw.polygon([tuple(corner) for corner in triangle], fill=1)
    return torch.from_numpy(np.array(picture))


@torch.no_grad()
def measure_garment(
    avatar: Avatar, capture: MultiViewCapture, sequence: str, stride: int
) -> dict[str, GarmentFigures] | None:
    """Return the garment's figures on every `stride`-th frame; None without truth or a chart.

    Beside the prediction: `template` is the garment at rest under skinning alone, what a model without any
    history gives; `second` is another simulation of the same motion, begun from a slightly different state:
    what cannot be predicted. `jitter` is over all frames; that of the `truth` is what it should be.
    """
    runs, garment = capture.garment_runs(sequence), avatar.garment_texels()
    if not runs or not len(garment):
        return None
    truth = torch.from_numpy(capture.garment(sequence))
    faces = torch.from_numpy(capture.garment_faces(sequence))
    rows = avatar.texels[garment].cpu() // avatar.atlas_size[1]
    lowest, hem = (rows == avatar.garments[-1].rows[-1]).nonzero().squeeze(1), hem_loop(truth[0], faces)
    motion = capture.motions[sequence]
    rollout = roll_out(avatar, motion)
    sequences = {"predicted": rollout, "template": template_sequence(rollout, avatar, motion)}
    clouds = {
        name: (torch.stack([gaussians.means[garment] for _, gaussians in frames]).cpu(), lowest)
        for name, frames in sequences.items()
    }
    if runs > 1:
        clouds["second"] = (torch.from_numpy(capture.garment(sequence, run=1)), hem)
    clouds["truth"] = (truth, hem)
    return {
        name: GarmentFigures(
            **_summarize(points[::stride], border, truth[::stride], faces, hem),
            jitter=measure_jitter(points, motion.fps),
        )
        for name, (points, border) in clouds.items()
    }


def _summarize(
    clouds: Float[Tensor, "f p 3"],
    border: Int64[Tensor, " b"],
    truth: Float[Tensor, "f v 3"],
    faces: Int64[Tensor, "t 3"],
    hem: Int64[Tensor, " h"],
) -> dict[str, float]:
    shapes, errors = [], []
    for points, vertices in zip(clouds, truth, strict=True):
        shapes.append(measure_shape(points, vertices, faces))
        radius, height = measure_hem(points[border])
        true_radius, true_height = measure_hem(vertices[hem])
        errors.append(((radius - true_radius) ** 2, (height - true_height) ** 2))
    means = {name: statistics.fmean(shape[name] for shape in shapes) for name in shapes[0]}
    radius, height = (statistics.fmean(column) ** 0.5 for column in zip(*errors, strict=True))
    return means | {"hem_radius": radius, "hem_height": height}
