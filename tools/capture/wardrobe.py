"""The dressed body as layers of skinned triangles with painted vertices: skin, shirt, socks and shoes, hair.

Each layer is a part of the body's own surface, refined to about a centimetre, smoothed and set off along
the normals. Rest frame of the body: Y up, facing +Z, metres. Colours are linear albedo.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from capture.prints import CREAM, linear, noise, paint_shirt
from dsar.types import Body

SKIN, BLUSH, LIPS = linear(222, 172, 146), linear(206, 132, 112), linear(176, 84, 84)
HAIR, HAIR_LIGHT = linear(46, 30, 22), linear(96, 62, 40)
SOLE, SHOE = linear(232, 228, 220), linear(150, 58, 52)
EYE_WHITE, IRIS, BROW = linear(232, 228, 224), linear(52, 36, 26), linear(58, 40, 30)
HEAD_JOINT, NECK_JOINT = 15, 12
_HAIRLINE = ([-0.17, -0.10, -0.075, -0.035, 0.0, 0.05], [-0.075, -0.055, -0.01, 0.03, 0.058, 0.066])
"""Metres in front of the eyes, and above them: nape, behind the ear, over it, temple, forehead."""


@dataclass(frozen=True)
class Layer:
    """Triangles that move with the body."""

    vertices: Float[ndarray, "n 3"]
    """Rest positions."""
    weights: Float[ndarray, "n j"]
    """Skinning weights."""
    faces: Int[ndarray, "t 3"]
    albedo: Float[ndarray, "n 3"]


def dress(body: Body, parts: Int[ndarray, " v"], part_names: list[str], seed: int) -> list[Layer]:
    """Return all layers of the dressed body, without the skirt.

    Args:
        body: The embedded body at rest.
        parts: Label of each vertex as index into `part_names`.
        part_names: Must contain skin, lips, nails, scalp, eye and iris.
        seed: Of the skin's and the hair's variation.
    """
    rng = np.random.default_rng(seed)
    surface = _refine(body, parts)
    label = {name: surface.parts == k for k, name in enumerate(part_names)}
    shirt, socks, hair = _shirt_region(surface), _sock_region(surface), _hair_region(surface, label)
    in_shoe = surface.vertices[:, 1] < surface.vertices[:, 1].min() + 0.07
    skin = Layer(surface.vertices, surface.weights, surface.faces, _paint_skin(surface, label, rng))
    covered = _erode(shirt | socks | in_shoe, surface.faces, 2)
    layers = [_select(skin, ~covered)]
    layers.append(_cover(surface, shirt, 0.009, 25, paint_shirt(surface.vertices)))
    layers.append(_cover(surface, socks, 0.006, 10, np.broadcast_to(CREAM, surface.vertices.shape)))
    layers += [_shape_shoe(surface, side) for side in (0, 1)]
    strands = noise(surface.vertices * np.array([1.0, 0.15, 0.5]), 0.012, rng)
    tint = np.clip(0.35 + 0.25 * strands, 0, 1)[:, None]
    layers.append(_cover(surface, hair, 0.022, 6, HAIR + tint * (HAIR_LIGHT - HAIR), 0.1))
    layers.append(_bun(surface, hair, rng))
    return layers


@dataclass(frozen=True)
class _Surface:
    """The refined body with what the painters look at."""

    vertices: Float[ndarray, "n 3"]
    normals: Float[ndarray, "n 3"]
    weights: Float[ndarray, "n j"]
    faces: Int[ndarray, "t 3"]
    parts: Int[ndarray, " n"]
    joints: Float[ndarray, "j 3"]


def _refine(body: Body, parts: Int[ndarray, " v"]) -> _Surface:
    """Return the body with every long edge halved, thrice at most."""
    vertices, faces = body.vertices.double().numpy(), body.faces.numpy().astype(np.int64)
    weights, parts = body.weights.double().numpy(), parts.astype(np.int64)
    for _ in range(3):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        a, b = unique.T
        middle = 0.5 * (vertices[a] + vertices[b])
        split = np.linalg.norm(vertices[a] - vertices[b], axis=1) > _edge_length(middle)
        index = np.full(len(unique), -1)
        index[split] = len(vertices) + np.arange(split.sum())
        a, b = a[split], b[split]
        vertices = np.concatenate([vertices, 0.5 * (vertices[a] + vertices[b])])
        weights = np.concatenate([weights, 0.5 * (weights[a] + weights[b])])
        parts = np.concatenate([parts, np.where(parts[a] == parts[b], parts[a], 0)])
        faces = _split_faces(faces, index[inverse.reshape(3, -1)].T)
    normals = _normals(vertices, faces)
    return _Surface(vertices, normals, weights, faces, parts, body.joints.double().numpy())


def _edge_length(points: Float[ndarray, "e 3"]) -> Float[ndarray, " e"]:
    """Return the longest edge wanted at points: under a centimetre for the shirt, two on skin."""
    shirt = (points[:, 1] > 0.14) & (np.abs(points[:, 0]) < 0.33)
    return np.where(shirt, 0.0085, 0.022)


def _split_faces(faces: Int[ndarray, "t 3"], middle: Int[ndarray, "t 3"]) -> Int[ndarray, "s 3"]:
    """Return triangles refined at the edge midpoints that exist (index >= 0), without cracks."""
    result = []
    count = (middle >= 0).sum(1)
    result.append(faces[count == 0])
    f, m = faces[count == 3], middle[count == 3]
    result += [np.stack([f[:, k], m[:, k], m[:, k - 1]], -1) for k in range(3)] + [m]
    for k in range(3):
        # Exactly edge k is split.
        one = (count == 1) & (middle[:, k] >= 0)
        f, m = np.roll(faces[one], -k, 1), middle[one, k]
        result += [np.stack([f[:, 0], m, f[:, 2]], -1), np.stack([m, f[:, 1], f[:, 2]], -1)]
        # Edges k and k + 1 are split.
        two = (count == 2) & (middle[:, k] >= 0) & (middle[:, (k + 1) % 3] >= 0)
        f, m, n = np.roll(faces[two], -k, 1), middle[two, k], middle[two, (k + 1) % 3]
        result += [
            np.stack([f[:, 0], m, f[:, 2]], -1),
            np.stack([m, n, f[:, 2]], -1),
            np.stack([m, f[:, 1], n], -1),
        ]
    return np.concatenate(result)


def _normals(vertices: Float[ndarray, "n 3"], faces: Int[ndarray, "t 3"]) -> Float[ndarray, "n 3"]:
    corners = vertices[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    np.add.at(normals, faces, area[:, None])
    return normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-20)


def _smooth(
    values: Float[ndarray, "n c"], faces: Int[ndarray, "t 3"], moves: Bool[ndarray, " n"], rounds: int
) -> Float[ndarray, "n c"]:
    """Return values averaged with their neighbours several times where `moves` holds."""
    edges = np.unique(np.sort(_edges(faces), 1), axis=0)
    degree = np.bincount(edges.ravel(), minlength=len(values))[:, None]
    for _ in range(rounds):
        total = np.zeros_like(values)
        np.add.at(total, edges[:, 0], values[edges[:, 1]])
        np.add.at(total, edges[:, 1], values[edges[:, 0]])
        mean = total / np.maximum(degree, 1)
        values = np.where(moves[:, None] & (degree > 0), 0.5 * (values + mean), values)
    return values


def _edges(faces: Int[ndarray, "t k"]) -> Int[ndarray, "e 2"]:
    """Return the sides of polygons; a polygon may be a mere edge."""
    return np.concatenate([np.stack([faces[:, k - 1], faces[:, k]], -1) for k in range(faces.shape[1])])


def _rim(faces: Int[ndarray, "t 3"]) -> Int[ndarray, "e 2"]:
    """Return the edges that only one triangle has: seams of neck, sleeves and waist."""
    unique, count = np.unique(np.sort(_edges(faces), 1), axis=0, return_counts=True)
    return unique[count == 1]


def _erode(region: Bool[ndarray, " n"], faces: Int[ndarray, "t 3"], rounds: int) -> Bool[ndarray, " n"]:
    """Return the region without its outermost rings of vertices."""
    for _ in range(rounds):
        rim = faces[~region[faces].all(1)]
        region = region.copy()
        region[rim] = False
    return region


def _select(layer: Layer, keep: Bool[ndarray, " n"]) -> Layer:
    """Return the triangles that touch a kept vertex, with unused vertices dropped."""
    faces = layer.faces[keep[layer.faces].any(1)]
    used = np.unique(faces)
    index = np.zeros(len(layer.vertices), np.int64)
    index[used] = np.arange(len(used))
    return Layer(layer.vertices[used], layer.weights[used], index[faces], layer.albedo[used])


def _cover(
    surface: _Surface,
    region: Bool[ndarray, " n"],
    thickness: float,
    rounds: int,
    albedo: Float[ndarray, "n 3"],
    hem: float = 0.45,
) -> Layer:
    """Return clothing over a region: smoothed and lifted off the skin, at its hem by a share only."""
    faces = surface.faces[region[surface.faces].all(1)]
    rim = _rim(faces)
    inner = _erode(region, surface.faces, 1)
    smooth = _smooth(surface.vertices, faces, inner, rounds)
    smooth = _smooth(smooth, rim, region, 14)
    normals = _smooth(surface.normals, faces, region, 4)
    # Smoothing shrinks: cloth spans hollows but never sinks into the skin.
    sunk = np.minimum(((smooth - surface.vertices) * surface.normals).sum(1), 0.0)
    smooth = smooth - _smooth(sunk[:, None], faces, region, rounds // 4) * surface.normals
    depth = _smooth(inner[:, None].astype(float), faces, region, 3)
    lifted = smooth + normals * thickness * (hem + (1 - hem) * depth)
    layer = Layer(lifted, surface.weights, surface.faces, albedo)
    return _select(Layer(lifted, surface.weights, faces, albedo), np.ones(len(layer.vertices), bool))


def _shirt_region(surface: _Surface) -> Bool[ndarray, " n"]:
    x, y, z = surface.vertices.T
    # A scoop that drops in front and stays high at the nape.
    collar = (x / 0.098) ** 2 + ((z - 0.045) / 0.085) ** 2 < 1
    collar &= y > 0.575 - 0.75 * np.clip(z + 0.01, 0, None)
    head = surface.weights[:, [HEAD_JOINT, NECK_JOINT, 22, 23, 24]].sum(1) > 0.4
    return (y > 0.16) & (y < 0.66) & (np.abs(x) < 0.305) & ~collar & ~head & _off_hands(surface)


def _off_hands(surface: _Surface) -> Bool[ndarray, " n"]:
    return surface.weights[:, 20:22].sum(1) + surface.weights[:, 25:].sum(1) < 0.3


def _sock_region(surface: _Surface) -> Bool[ndarray, " n"]:
    """Return the ankles, from inside the shoes to the socks' upper edge."""
    height = surface.vertices[:, 1] - surface.vertices[:, 1].min()
    return (height > 0.045) & (height < 0.125) & (surface.vertices[:, 2] < surface.joints[7, 2] + 0.075)


def _shape_shoe(surface: _Surface, side: int) -> Layer:
    """Return a shoe: the foot's convex outline, rounded by the leather's thickness."""
    ground = surface.vertices[:, 1].min()
    foot = (surface.vertices[:, 1] < ground + 0.075) & (surface.vertices[:, 0] * (1 - 2 * side) > 0)
    points, weights = surface.vertices[foot], surface.weights[foot]
    outward, faces = _ball(64, 32)
    reach = (outward @ points.T) / 0.005
    share = np.exp(reach - reach.max(1, keepdims=True))
    share /= share.sum(1, keepdims=True)
    vertices = share @ points + 0.012 * outward
    ahead = vertices[:, 2] - surface.joints[7 + side, 2]
    rubber = (outward[:, 1] < -0.2) | (ahead > 0.135)
    color = np.where(rubber[:, None], SOLE, SHOE)
    return Layer(vertices, share @ weights, faces, color)


def _ball(around: int, down: int) -> tuple[Float[ndarray, "n 3"], Int[ndarray, "t 3"]]:
    """Return the vertices of a unit ball and its triangles, counter-clockwise seen from outside."""
    u, v = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.linspace(0, np.pi, down + 1), indexing="ij")
    ball = np.stack([np.sin(u) * np.sin(v), np.cos(v), np.cos(u) * np.sin(v)], -1).reshape(-1, 3)
    a = (np.arange(around)[:, None] * (down + 1) + np.arange(down)).ravel()
    b = (a + down + 1) % len(ball)
    return ball, np.concatenate([np.stack([a, a + 1, b], -1), np.stack([a + 1, b + 1, b], -1)])


def _eyes(surface: _Surface, label: dict[str, ndarray]) -> list[Float[ndarray, "3"]]:
    balls = surface.vertices[label["eye"] | label["iris"]]
    return [balls[balls[:, 0] * sign > 0].mean(0) for sign in (1, -1)]


def _hair_region(surface: _Surface, label: dict[str, ndarray]) -> Bool[ndarray, " n"]:
    """Return the scalp: above a hairline that runs from the forehead over the ears to the nape."""
    x, y, z = surface.vertices.T
    eye = np.mean(_eyes(surface, label), 0)
    forward = z - eye[2]
    hairline = np.interp(forward, *_HAIRLINE)
    ear = (np.abs(x) > 0.066) & (y - eye[1] < 0.02) & (forward > -0.11)
    head = surface.weights[:, [HEAD_JOINT, NECK_JOINT, 22, 23, 24]].sum(1) > 0.9
    return head & (y - eye[1] > hairline) & ~ear & ~label["eye"] & ~label["iris"]


def _bun(surface: _Surface, hair: Bool[ndarray, " n"], rng: np.random.Generator) -> Layer:
    """Return a knot of hair at the back of the head."""
    head = surface.vertices[hair]
    center = np.array([0.0, head[:, 1].max() - 0.075, head[:, 2].min() - 0.028])
    ball, faces = _ball(40, 20)
    swirl = np.arctan2(ball[:, 1], ball[:, 0]) * 3 + 9 * ball[:, 2]
    vertices = center + ball * np.array([0.043, 0.043, 0.036]) * (1 + 0.05 * np.sin(2 * swirl))[:, None]
    tint = np.clip(0.35 + 0.3 * np.sin(2 * swirl) + 0.1 * rng.normal(size=len(ball)), 0, 1)[:, None]
    weights = np.zeros((len(ball), surface.weights.shape[1]))
    weights[:, HEAD_JOINT] = 1
    return Layer(vertices, weights, faces, HAIR + tint * (HAIR_LIGHT - HAIR))


def _paint_skin(
    surface: _Surface, label: dict[str, ndarray], rng: np.random.Generator
) -> Float[ndarray, "n 3"]:
    points = surface.vertices
    mottle = 1 + 0.035 * noise(points, 0.10, rng) + 0.02 * noise(points, 0.025, rng)
    color = SKIN * mottle[:, None]

    def flush(center: ndarray, radius: float, strength: float, tint: ndarray = BLUSH) -> None:
        near = strength * np.exp(-(((points - center) ** 2).sum(1)) / radius**2)[:, None]
        color[:] += near * (tint - color)

    for joint in (4, 5, 18, 19):
        flush(surface.joints[joint] + np.array([0, 0, 0.05 if joint < 6 else -0.04]), 0.045, 0.45)
    for eye in _eyes(surface, label):
        side = np.sign(eye[0])
        flush(eye + np.array([0.012 * side, -0.040, 0.01]), 0.024, 0.5)
        flush(eye + np.array([0.0, 0.008, 0.008]), 0.012, 0.35, BROW)
        offset = points - eye
        across = offset[:, 0] * side
        arch = 0.0235 + 0.10 * (across + 0.016) - 3.5 * (across + 0.016) ** 2
        thick = np.clip(1.6 - np.abs(offset[:, 1] - arch) / 0.0036, 0, 1)
        wide = np.clip(1.5 - np.abs(across - 0.004) / 0.014, 0, 1)
        soft = (0.95 * thick * wide * (offset[:, 2] > -0.02))[:, None]
        color += soft * (BROW - color)
    color[label["lips"]] = LIPS
    color[label["nails"]] = linear(214, 120, 118)
    color[label["scalp"]] = HAIR
    color[label["eye"]] = EYE_WHITE
    color[label["iris"]] = IRIS
    return color
