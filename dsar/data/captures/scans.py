"""Textured scans seen by cameras of our own, for captures that release few of theirs.

Light is baked into the texture, so these views have none of a lens's or a material's own; four real cameras
alone leave much of a person unseen.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dsar.data.images.decoding import CACHE
from dsar.data.images.photos import Photos
from dsar.errors import CaptureError
from dsar.geometry.cameras import look_at
from dsar.pickles import PICKLE_ERRORS, read_pickle
from dsar.raster.mesh import rasterize_mesh
from dsar.types import Camera

VIRTUAL_CAMERAS = 4
"""Cameras that are added to the released ones."""
_SAMPLES = 2
_UPPER, _LOWER, _OUTER = 3, 4, 5
_LABELS = range(6)
"""4D-DRESS's labels of a scan's vertices: skin, hair, shoe, upper, lower, outer."""


@dataclass(frozen=True)
class Scans:
    """A take's textured meshes, a pickle of each and one of its texture by frame."""

    root: Path
    """Their folder."""
    frames: Sequence[str]
    """The frames' names."""
    labels: Path | None = None
    """Folder of the labels of the meshes' vertices, a pickle by frame."""

    def paths(self, frame: int) -> tuple[Path, Path]:
        """Return where a frame's mesh and texture are."""
        name = self.frames[frame]
        return self.root / f"mesh-f{name}.pkl", self.root / f"atlas-f{name}.pkl"

    def has(self, frame: int) -> bool:
        """Return whether a frame has both."""
        return all(path.is_file() for path in self.paths(frame))

    @cached_property
    def complete(self) -> bool:
        """Whether all frames have both."""
        return all(self.has(frame) for frame in range(len(self.frames)))

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """The middle of the first scan, metres, in the files' world."""
        vertices = self._read(self.paths(0)[0])["vertices"]
        return (vertices.min(0) + vertices.max(0)) / 2

    def render(self, camera: Camera, frame: int) -> UInt8[np.ndarray, "h w 4"]:
        """Return a view: straight sRGB and coverage, of four samples a pixel.

        Raises:
            CaptureError: mesh or texture are missing, damaged, or not what they should be.
        """
        where, atlas = self.paths(frame)
        mesh, texture = self._read(where), self._texture(atlas)
        fine = camera.resized(_SAMPLES * camera.width, _SAMPLES * camera.height)
        vertices, faces = torch.from_numpy(mesh["vertices"]), torch.from_numpy(mesh["faces"])
        view = rasterize_mesh(vertices, faces, fine)
        hit = view.faces >= 0
        uv = torch.from_numpy(mesh["uvs"])[faces[view.faces[hit]]]
        colors = torch.zeros(*hit.shape, 4)
        colors[hit] = sample_texture(texture, (view.weights[hit][..., None] * uv).sum(-2))
        blocks = colors.unflatten(0, (-1, _SAMPLES)).unflatten(2, (-1, _SAMPLES)).mean((1, 3))
        alpha = blocks[..., 3:]
        straight = torch.cat([blocks[..., :3] / alpha.clamp_min(1e-6), alpha], -1)
        return (straight * 255).round().byte().numpy()

    def label_path(self, frame: int) -> Path | None:
        """Return where the labels of a frame's mesh are; None where it has none."""
        path = self.labels and self.labels / f"label-f{self.frames[frame]}.pkl"
        return path if path and path.is_file() and self.paths(frame)[0].is_file() else None

    def garment_mask(self, camera: Camera, frame: int, path: Path) -> Bool[np.ndarray, "h w"]:
        """Return where a camera sees the outer garment, without one upper or lower, by the labels in a file.

        Raises:
            CaptureError: mesh or labels are damaged, or not what they should be.
        """
        mesh = self._read(self.paths(frame)[0])
        labels = _read_labels(path, len(mesh["vertices"]))
        garment = labels == _OUTER
        if not garment.any():
            garment = (labels == _UPPER) | (labels == _LOWER)
        vertices, faces = torch.from_numpy(mesh["vertices"]), torch.from_numpy(mesh["faces"])
        view = rasterize_mesh(vertices, faces, camera)
        corners = torch.from_numpy(garment)[faces[view.faces.clamp_min(0)]]
        share = (view.weights * corners).sum(-1)
        return ((view.faces >= 0) & (share >= 0.5)).numpy()

    def _read(self, path: Path) -> Mapping[str, np.ndarray]:
        content = _load(path)
        kinds = {"vertices": np.float32, "uvs": np.float32, "faces": np.int64}
        try:
            mesh = {key: np.asarray(content[key], kind) for key, kind in kinds.items()}
        except (KeyError, TypeError, ValueError) as error:
            raise CaptureError(f"scan {path}: expected vertices, faces and uvs ({error!r})") from error
        count = mesh["vertices"].size // 3
        shapes = {"vertices": (count, 3), "uvs": (count, 2), "faces": (mesh["faces"].size // 3, 3)}
        wrong = [key for key, shape in shapes.items() if mesh[key].shape != shape]
        if (
            wrong
            or not (count and mesh["faces"].size)
            or mesh["faces"].min() < 0
            or mesh["faces"].max() >= count
        ):
            found = {key: value.shape for key, value in mesh.items()}
            raise CaptureError(f"scan {path}: expected one uv a vertex and faces of them, found {found}")
        if not np.isfinite(mesh["vertices"]).all():
            raise CaptureError(f"scan {path}: has vertices that are not finite")
        return mesh

    @staticmethod
    def _texture(path: Path) -> Float[Tensor, "h w 3"]:
        image = np.asarray(_load(path))
        if image.ndim != 3 or image.shape[2] < 3 or image.dtype != np.uint8:
            raise CaptureError(
                f"texture {path}: expected 8-bit RGB, found shape {image.shape} of {image.dtype}"
            )
        return torch.from_numpy(np.ascontiguousarray(image[..., :3])).float() / 255


def _load(path: Path) -> Any:
    """Return what a pickle holds; kept for the next camera of the same frame, while the file is the same."""
    try:
        state = path.stat()
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error}); download it again") from error
    return _load_once(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=4)
def _load_once(path: Path, _time: int, _size: int) -> Any:
    try:
        return read_pickle(path)
    except PICKLE_ERRORS as error:
        raise CaptureError(f"{path}: cannot be read as data ({error}); download it again") from error


def _read_labels(path: Path, vertices: int) -> Int[np.ndarray, " v"]:
    """Return a label of 4D-DRESS for each vertex of a mesh."""
    content = _load(path)
    try:
        labels = np.asarray(content["scan_labels"], np.int64)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise CaptureError(f"labels {path}: expected scan_labels ({error!r}); download it again") from error
    if labels.shape != (vertices,) or not np.isin(labels, _LABELS).all():
        raise CaptureError(
            f"labels {path}: expected {vertices} labels of 0 to 5, one a vertex of the scan, found "
            f"shape {labels.shape} of {labels.min(initial=0)} to {labels.max(initial=0)}"
        )
    return labels


def sample_texture(texture: Float[Tensor, "h w 3"], uv: Float[Tensor, "n 2"]) -> Float[Tensor, "n 4"]:
    """Return bilinear colours at texture coordinates, and ones. Row 0 of the data set's textures is v = 0."""
    grid = (2 * uv - 1)[None, None]
    image = texture.permute(2, 0, 1)[None]
    colors = torch.nn.functional.grid_sample(image, grid, padding_mode="border", align_corners=False)
    return torch.cat([colors[0, :, 0].T, torch.ones(len(uv), 1)], -1)


@dataclass(frozen=True)
class PhotosAndScans:
    """Photographs of real cameras and views of scans; implements `Views`."""

    photos: Photos
    """What the released cameras saw."""
    scans: Scans
    """What the others see."""
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    """The others, by name, in the scans' world."""
    released: Mapping[str, Camera] = field(default_factory=dict)
    """The released ones, by name, in the scans' world."""

    def has(self, camera: Camera, frame: int) -> bool:
        """Return whether there is a photograph with its mask, or a textured scan."""
        return self.scans.has(frame) if camera.name in self.cameras else self.photos.has(camera, frame)

    def read(self, camera: Camera, frame: int) -> UInt8[np.ndarray, "h w 4"]:
        """Return an image, or raise CaptureError."""
        if camera.name not in self.cameras:
            return self.photos.read(camera, frame)
        own = self.cameras[camera.name]
        key = (self.scans.paths(frame)[0], camera.name)
        return CACHE.get(key, lambda: self.scans.render(own, frame))

    def garment_mask(self, camera: Camera, frame: int) -> Bool[np.ndarray, "h w"] | None:
        """Return where a camera sees a garment by the scans' labels; None without, or raise CaptureError."""
        own = {**self.released, **self.cameras}.get(camera.name)
        path = self.scans.label_path(frame)
        if own is None or path is None:
            return None
        return CACHE.get((path, camera.name), lambda: self.scans.garment_mask(own, frame, path))

    def check_samples(self, cameras: Sequence[Camera]) -> None:
        """Look at some photographs of each released camera, log what is converted, or raise CaptureError."""
        self.photos.check_samples([camera for camera in cameras if camera.name not in self.cameras])

    def expected_files(self, camera: Camera) -> str:
        """Return where a camera's first image should come from, in words."""
        if camera.name in self.cameras:
            return " and ".join(map(str, self.scans.paths(0)))
        return self.photos.expected_files(camera)


def virtual_cameras(released: Sequence[Camera], center: Float[np.ndarray, "3"]) -> list[Camera]:
    """Return cameras in a ring about a person, as far off and as high as the released ones, between them.

    Y is up.
    """
    centers = np.stack([camera.center.double().numpy() for camera in released]) - center
    azimuths = np.arctan2(centers[:, 0], centers[:, 2])
    # The middle of the first gap going round; the ring is even.
    azimuth_gaps = np.sort(np.mod(azimuths - azimuths[0], 2 * math.pi))
    first = azimuths[0] + (azimuth_gaps[1] / 2 if len(azimuth_gaps) > 1 else math.pi / VIRTUAL_CAMERAS)
    distance, height = np.hypot(centers[:, 0], centers[:, 2]).mean(), centers[:, 1].mean()
    template, cameras = released[0], []
    K = template.K.clone()
    K[0, 2], K[1, 2] = template.width / 2, template.height / 2
    for index in range(VIRTUAL_CAMERAS):
        angle = first + 2 * math.pi * index / VIRTUAL_CAMERAS
        position = center + np.array([distance * math.sin(angle), height, distance * math.cos(angle)])
        transform = look_at(position, center.astype(np.float64))
        cameras.append(dataclasses.replace(template, K=K, T_camera_world=transform, name=f"scan{index}"))
    return cameras
