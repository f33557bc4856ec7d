"""The skirt's cut, how it hangs on the body, and its simulation through one take.

A flared skirt is part of an annulus: the inner arc is sewn to a band around the waist. Metres.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from capture.cloth import Collider, Fabric, build_struts, simulate
from dsar.body.skinning import forward_kinematics, skin_points
from dsar.types import Body, Motion


@dataclass(frozen=True)
class Cut:
    """Measures of a flared skirt and of its grid; heights are in the body's rest frame."""

    columns: int = 96
    rows: int = 30
    band_rows: int = 3
    """Rows sewn to the waist."""
    waist_height: float = 0.235
    """Of the skirt's upper edge."""
    hip_height: float = 0.02
    length: float = 0.50
    flare: float = 2.3
    """Hem over hip circumference."""
    wave: float = 0.06
    """Slope of the irregular wave that the folds start from."""
    lowest: float = -0.62
    """Height below which the body does not collide."""
    hands: bool = True
    """Whether hands and forearms collide."""
    painted: tuple[int, int] = (2, 3)
    """Painted vertices per simulated one, down and around."""
    stored: tuple[int, int] = (2, 2)
    """Rows, counted up from the hem, and columns of which one is stored as the truth."""


FLARED = Cut()
"""The thin skirt of the first subject."""
PRE_ROLL = 75
_HANDS = range(18, 55)
_EASE = 30


@dataclass(frozen=True)
class Skirt:
    """A skirt fitted to a body in its rest pose."""

    cut: Cut
    band: Float[ndarray, "p 3"]
    """Rest positions of the rows sewn to the waist, row by row."""
    band_weights: Float[ndarray, "p j"]
    """Skinning weights of the band."""
    pattern: Float[ndarray, "r c 2"]
    """Flat cut in polar coordinates: radius, angle."""
    turn: float
    """Angle of the whole cut."""

    @property
    def faces(self) -> Int[ndarray, "t 3"]:
        """Triangles of the closed grid, counter-clockwise seen from outside."""
        return grid_faces(self.cut.rows, self.cut.columns)


def grid_faces(rows: int, columns: int) -> Int[ndarray, "t 3"]:
    """Return the triangles of a grid closed around; rows go down, columns counter-clockwise from above."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = row * columns + column, row * columns + (column + 1) % columns
    c, d = a + columns, b + columns
    return np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).reshape(-1, 3).astype(np.int32)


def fit_skirt(body: Body, cut: Cut = FLARED) -> Skirt:
    """Return a skirt cut to the waist of a body."""
    vertices, weights = body.vertices.numpy().astype(float), body.weights.numpy().astype(float)
    spacing = cut.length / (cut.rows - 1)
    heights = cut.waist_height - spacing * np.arange(cut.band_rows)
    rows = [_waist_ring(vertices, height, cut.columns) for height in heights]
    band = np.concatenate(rows)
    torso = np.abs(vertices[:, 0]) < 0.24
    distance = np.linalg.norm(band[:, None] - vertices[None, torso], axis=-1)
    near = np.exp(-0.5 * (distance / 0.03) ** 2) + 1e-12
    band_weights = near @ weights[torso]
    circumference = _perimeter(rows[0])
    turn = (cut.flare * _perimeter(_section(vertices, cut.hip_height, 0.0)) - circumference) / cut.length
    radius = circumference / turn + spacing * np.arange(cut.rows)
    start = turn * np.arange(cut.columns) / cut.columns
    pattern = np.stack(np.broadcast_arrays(radius[:, None], start[None]), -1)
    return Skirt(cut, band, band_weights / band_weights.sum(1, keepdims=True), pattern, turn)


def _section(vertices: Float[ndarray, "v 3"], height: float, gap: float) -> Float[ndarray, "n 2"]:
    """Return the trunk's smooth convex outline (x, z) at a height and a gap off the skin, front to left."""
    slab = vertices[(np.abs(vertices[:, 1] - height) < 0.03) & (np.abs(vertices[:, 0]) < 0.22)][:, [0, 2]]
    middle = 0.5 * (slab.min(0) + slab.max(0))
    angle = 2 * np.pi * np.arange(720) / 720
    outward, along = (
        np.stack([np.sin(angle), np.cos(angle)], -1),
        np.stack([np.cos(angle), -np.sin(angle)], -1),
    )
    spectrum = np.fft.rfft(((slab - middle) @ outward.T).max(0))
    spectrum[5:] = 0
    support, slope = gap + np.fft.irfft(spectrum), np.fft.irfft(spectrum * 1j * np.arange(len(spectrum)))
    # The outline is the envelope of its support lines: h n + h' t.
    return middle + support[:, None] * outward + slope[:, None] * along


def _perimeter(outline: Float[ndarray, "n d"]) -> float:
    return float(np.linalg.norm(np.roll(outline, -1, 0) - outline, axis=1).sum())


def _waist_ring(vertices: Float[ndarray, "v 3"], height: float, count: int) -> Float[ndarray, "c 3"]:
    """Return the band's points at a height, evenly spaced and just off the skin."""
    outline = _section(vertices, height, 0.012)
    closed = np.concatenate([outline, outline[:1]])
    steps = np.linalg.norm(np.diff(closed, axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    target = travelled[-1] * np.arange(count) / count
    even = np.stack([np.interp(target, travelled, closed[:, k]) for k in range(2)], -1)
    return np.stack([even[:, 0], np.full(count, height), even[:, 1]], -1)


def prepend_pre_roll(motion: Motion, frames: int = PRE_ROLL) -> Motion:
    """Return the motion after an unrecorded rest: eased into from a plain stance, then held still."""
    still = torch.zeros_like(motion.rotations[:1])
    still[:, 0] = motion.rotations[0, 0]
    still[:, 16, 2], still[:, 17, 2] = -0.8, 0.8
    ease = torch.linspace(0, 1, _EASE)[:, None, None]
    ease = ease * ease * (3 - 2 * ease)
    lead = still + ease * (motion.rotations[:1] - still)
    held = motion.rotations[:1].expand(frames - _EASE, -1, -1)
    translations = motion.translations[:1].expand(frames, -1)
    return Motion(
        torch.cat([lead, held, motion.rotations]),
        torch.cat([translations, motion.translations]),
        motion.fps,
        motion.name,
    )


def pose_points(
    body: Body, motion: Motion, points: Float[ndarray, "n 3"], weights: Float[ndarray, "n j"]
) -> Float[ndarray, "f n 3"]:
    """Return rest points carried through every frame of a motion, world metres."""
    transforms = forward_kinematics(body, motion.rotations, motion.translations)
    p, w = torch.as_tensor(points, dtype=torch.float32), torch.as_tensor(weights, dtype=torch.float32)
    return np.stack([skin_points(p, w, T).numpy() for T in transforms])


def vertex_normals(vertices: Float[ndarray, "f v 3"], faces: Int[ndarray, "t 3"]) -> Float[ndarray, "f v 3"]:
    """Return area-weighted unit normals per frame."""
    a, b, c = (vertices[:, faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for frame, area in zip(normals, areas, strict=True):
        for k in range(3):
            np.add.at(frame, faces[:, k], area)
    return normals / (np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-20)


def drape(
    body: Body, skirt: Skirt, motion: Motion, fabric: Fabric, seed: int, disturbance: float = 0.0
) -> Float[ndarray, "f n 3"]:
    """Return the skirt's vertices at every recorded frame of a motion.

    Args:
        body: The body at rest.
        skirt: The fitted skirt.
        motion: What the body does from frame 0; the cloth comes to rest before it.
        fabric: Constants of the cloth.
        seed: Of the irregularity that the folds start from.
        disturbance: Peak speed in m/s of a wind that blows during the pre-roll only: a second true run.
    """
    rolled = prepend_pre_roll(motion)
    collider = build_collider(body, rolled, skirt.cut)
    anchors = pose_points(body, rolled, skirt.band, skirt.band_weights).astype(float)
    start = hang(skirt, anchors[0], seed)
    frames = len(rolled)
    blow = np.zeros((frames, 3))
    gust = np.sin(np.linspace(0, np.pi, PRE_ROLL - 25)) * disturbance
    blow[: PRE_ROLL - 25] = gust[:, None] * np.array([0.8, 0.0, 0.6])
    struts = build_struts(skirt.pattern, skirt.turn, fabric)
    shape = (skirt.cut.rows, skirt.cut.columns)
    run = simulate(start, anchors, struts, shape, collider, fabric, motion.fps, blow)
    return np.stack([x for i, x in enumerate(run) if i >= PRE_ROLL]).astype(np.float32)


def hang(skirt: Skirt, band: Float[ndarray, "p 3"], seed: int) -> Float[ndarray, "n 3"]:
    """Return a cone below the band with the cut's own slope and a slight irregular wave."""
    rng = np.random.default_rng(seed)
    cut = skirt.cut
    rings = band.reshape(cut.band_rows, cut.columns, 3)
    last = rings[-1]
    outward = last - last.mean(0)
    outward[:, 1] = 0
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(cut.columns) / cut.columns
    waves = [rng.uniform(0.5, 1) * np.cos(n * angle + rng.uniform(0, 2 * np.pi)) for n in (5, 7, 8, 11)]
    wave = np.sum(waves, 0)
    slope = skirt.turn / (2 * np.pi)
    drop = cut.length / (cut.rows - 1) * np.arange(1, cut.rows - cut.band_rows + 1)[:, None, None]
    lateral = outward * (slope + cut.wave * wave[:, None])
    vertical = np.array([0.0, -np.sqrt(1 - slope**2), 0.0])
    return np.concatenate([band, (last + drop * (lateral + vertical)).reshape(-1, 3)])


def build_collider(body: Body, motion: Motion, cut: Cut) -> Collider:
    """Return the trunk and legs and arms below the elbow as collision geometry over time."""
    posed, faces = build_collider_mesh(body, motion, cut)
    normals = vertex_normals(posed, faces)
    return Collider(posed.astype(float), normals.astype(float), _neighbours(faces, posed.shape[1]))


def build_collider_mesh(
    body: Body, motion: Motion, cut: Cut
) -> tuple[Float[ndarray, "f v 3"], Int[ndarray, "t 3"]]:
    """Return the vertices over time of what the skirt can touch, world metres, and their triangles."""
    vertices, weights, faces = body.vertices.numpy(), body.weights.numpy(), body.faces.numpy()
    lower = (vertices[:, 1] < cut.waist_height + 0.12) & (vertices[:, 1] > cut.lowest)
    hands = weights[:, list(_HANDS)].sum(1) > 0.5
    keep = lower | hands if cut.hands else lower
    index = np.cumsum(keep) - 1
    used = faces[keep[faces].all(1)]
    return pose_points(body, motion, vertices[keep], weights[keep]), index[used]


def _neighbours(faces: Int[ndarray, "t 3"], count: int) -> Int[ndarray, "v k"]:
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    degree = np.bincount(edges[:, 0], minlength=count)
    table = np.tile(np.arange(count)[:, None], (1, int(degree.max()) + 1))
    slot = np.arange(len(edges)) - np.concatenate([[0], np.cumsum(degree)[:-1]])[edges[:, 0]]
    table[edges[:, 0], slot] = edges[:, 1]
    return table.astype(np.int64)
