"""The dressed person as one moving mesh, the eight cameras, and the images of a frame."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray

from capture.garment import Cut, Skirt, grid_faces, vertex_normals
from capture.shading import Lighting, Stage
from capture.subjects import Paint
from capture.wardrobe import Layer
from dsar.body.skinning import skin_points
from dsar.geometry.cameras import look_at
from dsar.types import Camera

WIDTH, HEIGHT = 192, 256
# azimuth in degrees from the person's front, height and distance in metres, focal length and
# principal-point shift as shares of the image height and size.
_RIG = (
    (4, 1.00, 3.30, 1.47, (0.0, 0.0)),
    (48, 1.70, 3.25, 1.45, (0.0, 0.0)),
    (93, 1.05, 3.35, 1.49, (0.06, -0.02)),
    (137, 1.65, 3.20, 1.42, (0.0, 0.0)),
    (182, 1.00, 3.30, 1.48, (0.0, 0.0)),
    (228, 1.72, 3.30, 1.47, (0.0, 0.0)),
    (271, 0.98, 3.25, 1.44, (-0.05, 0.03)),
    (316, 1.68, 3.35, 1.50, (0.0, 0.0)),
)


def build_cameras() -> list[Camera]:
    """Return eight cameras all around at two heights; cam2 and cam6 have shifted principal points."""
    cameras = []
    for index, (azimuth, height, distance, focal, shift) in enumerate(_RIG):
        bearing = np.radians(azimuth)
        position = np.array([distance * np.sin(bearing), height, distance * np.cos(bearing)])
        f = focal * HEIGHT
        K = torch.tensor([[f, 0, WIDTH * (0.5 + shift[0])], [0, f, HEIGHT * (0.5 + shift[1])], [0, 0, 1]])
        target = np.array([position[0] * 0.02, 0.93, position[2] * 0.02])
        cameras.append(Camera(K, look_at(position, target), WIDTH, HEIGHT, f"cam{index}"))
    return cameras


@dataclass(frozen=True)
class Upsampling:
    """Smooth interpolation of the simulated grid to the painted one, as two small matrices."""

    rows: Float[ndarray, "R r"]
    columns: Float[ndarray, "C c"]

    def apply(self, values: Float[ndarray, "n k"]) -> Float[ndarray, "m k"]:
        """Return values on the painted grid, row by row."""
        grid = values.reshape(self.rows.shape[1], self.columns.shape[1], -1)
        return np.einsum("Rr,rck,Cc->RCk", self.rows, grid, self.columns, optimize=True).reshape(
            -1, grid.shape[-1]
        )


def build_upsampling(cut: Cut) -> Upsampling:
    """Return Catmull-Rom interpolation, closed around and linearly continued at the waist and the hem."""
    fine_rows, fine_columns = cut.painted
    return Upsampling(
        _cubic(fine_rows, cut.rows, closed=False), _cubic(fine_columns, cut.columns, closed=True)
    )


def _cubic(factor: int, coarse: int, *, closed: bool) -> Float[ndarray, "f c"]:
    fine = coarse * factor if closed else (coarse - 1) * factor + 1
    position = np.arange(fine) / factor
    cell = np.minimum(np.floor(position).astype(int), coarse - (1 if closed else 2))
    t = position - cell
    taps = np.stack(
        [
            0.5 * (-t + 2 * t**2 - t**3),
            0.5 * (2 - 5 * t**2 + 3 * t**3),
            0.5 * (t + 4 * t**2 - 3 * t**3),
            0.5 * (-(t**2) + t**3),
        ],
        -1,
    )
    matrix = np.zeros((fine, coarse))
    for k in range(4):
        index = cell + k - 1
        if closed:
            np.add.at(matrix, (np.arange(fine), index % coarse), taps[:, k])
            continue
        inside = np.clip(index, 0, coarse - 1)
        np.add.at(matrix, (np.arange(fine), inside), taps[:, k])
        # Beyond an end the grid goes on linearly: value(-1) = 2 value(0) - value(1).
        mirrored = np.where(index < 0, 1, coarse - 2)
        excess = np.where(index != inside, taps[:, k], 0.0)
        np.add.at(matrix, (np.arange(fine), inside), excess)
        np.add.at(matrix, (np.arange(fine), mirrored), -excess)
    return matrix


class DressedPerson:
    """Everything that is in front of the cameras."""

    def __init__(
        self, layers: list[Layer], skirt: Skirt, paint: Paint, lighting: Lighting, seed: int
    ) -> None:
        """Join the body's layers and the skirt into one mesh and paint the skirt."""
        offsets = np.cumsum([0, *(len(layer.vertices) for layer in layers)])
        self._rest = torch.from_numpy(np.concatenate([layer.vertices for layer in layers])).float()
        self._weights = torch.from_numpy(np.concatenate([layer.weights for layer in layers])).float()
        self._faces = np.concatenate([f.faces + o for f, o in zip(layers, offsets[:-1], strict=True)])
        self._upsampling = build_upsampling(skirt.cut)
        rows, columns = len(self._upsampling.rows), len(self._upsampling.columns)
        radius = np.repeat(self._upsampling.rows @ skirt.pattern[:, 0, 0], columns)
        angle = np.tile(
            np.interp(
                np.arange(columns) / skirt.cut.painted[1],
                np.arange(skirt.cut.columns + 1),
                [*skirt.pattern[0, :, 1], skirt.turn],
            ),
            rows,
        )
        albedo = [layer.albedo for layer in layers] + [paint(radius, angle, skirt.turn, seed)]
        faces = np.concatenate([self._faces, grid_faces(rows, columns) + offsets[-1]])
        self._skirt_faces = skirt.faces
        self._stage = Stage(faces, np.concatenate(albedo), lighting)

    def place(self, transforms: Float[torch.Tensor, "j 4 4"], cloth: Float[ndarray, "n 3"]) -> None:
        """Pose the body by T_world_rest of its joints, put the cloth's vertices, and light both."""
        body = skin_points(self._rest, self._weights, transforms).numpy()
        self._stage.move(np.concatenate([body, self._upsampling.apply(cloth)]))
        body_normals = vertex_normals(body[None], self._faces)[0]
        cloth_normals = vertex_normals(cloth[None], self._skirt_faces)[0]
        points = np.concatenate([body, cloth, cloth])
        light = self._stage.light(points, np.concatenate([body_normals, cloth_normals, -cloth_normals]))
        skin, front, back = np.split(light, [len(body), len(body) + len(cloth)])
        # The inside of a neckline or a sleeve sees half the light; the skirt's own is gathered.
        self._stage.shine(
            np.concatenate([skin, np.clip(self._upsampling.apply(front), 0, None)]),
            np.concatenate([0.5 * skin, np.clip(self._upsampling.apply(back), 0, None)]),
        )

    def photograph(self, camera: Camera) -> UInt8[ndarray, "h w 4"]:
        """Return one camera's image: straight sRGB and coverage."""
        return self._stage.view(camera)
