"""The usual mistakes in cameras, and which of them a projection has made."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.geometry.cameras import project
from dsar.types import Camera


@dataclass(frozen=True)
class Mistake:
    """What may be wrong with a camera."""

    name: str
    """A word for it, stable."""
    description: str
    """The same for people."""
    variants: tuple[Callable[[Camera], Camera], ...]
    """The ways to make it, each from a right camera."""


def name_mistake(
    camera: Camera, points: Float[Tensor, "n 3"], pixels: Float[Tensor, "n 2"], tolerance: float
) -> Mistake | None:
    """Return the mistake that explains why points are seen elsewhere than through the camera.

    Args:
        camera: The right one.
        points: World metres.
        pixels: Where the questionable camera has them; those that are not finite are left out.
        tolerance: Root mean square of the pixels that are still explained.
    """
    finite = pixels.isfinite().all(-1)
    if finite.sum() < 4:
        return None
    best: tuple[float, Mistake] | None = None
    for mistake in MISTAKES:
        for variant in mistake.variants:
            places, _ = project(variant(camera), points[finite])
            error = float((places - pixels[finite]).square().sum(-1).mean().sqrt())
            if error <= tolerance and (best is None or error < best[0]):
                best = error, mistake
    return best[1] if best else None


def _with_K(camera: Camera, change: Callable[[Tensor], None]) -> Camera:
    K = camera.K.clone()
    change(K)
    return dataclasses.replace(camera, K=K)


def _shifted(amount: float) -> Callable[[Camera], Camera]:
    def change(K: Tensor) -> None:
        K[:2, 2] += amount

    return lambda camera: _with_K(camera, change)


def _flipped(camera: Camera) -> Camera:
    def change(K: Tensor) -> None:
        K[1] = torch.tensor([0.0, 0.0, camera.height]).to(K) - K[1]

    return _with_K(camera, change)


def _transposed(camera: Camera) -> Camera:
    T = camera.T_camera_world.clone()
    T[:3, :3] = T[:3, :3].T.clone()
    return dataclasses.replace(camera, T_camera_world=T)


def _mirrored_principal_point(*axes: int) -> Callable[[Camera], Camera]:
    def mirrored(camera: Camera) -> Camera:
        def change(K: Tensor) -> None:
            for axis in axes:
                K[axis, 2] = (camera.width, camera.height)[axis] - K[axis, 2]

        return _with_K(camera, change)

    return mirrored


def _focal_of_other_axis(camera: Camera) -> Camera:
    def change(K: Tensor) -> None:
        K[0, 0], K[1, 1] = K[1, 1].clone(), K[0, 0].clone()

    return _with_K(camera, change)


def _angle_of_other_axis(camera: Camera, wide: bool) -> Camera:
    def change(K: Tensor) -> None:
        aspect = camera.width / camera.height
        K[[0, 1], [0, 1]] *= aspect if wide else 1 / aspect

    return _with_K(camera, change)


def _inverted(camera: Camera) -> Camera:
    T = torch.linalg.inv(camera.T_camera_world.double()).to(camera.T_camera_world)
    return dataclasses.replace(camera, T_camera_world=T)


def _farther(factor: float) -> Callable[[Camera], Camera]:
    def farther(camera: Camera) -> Camera:
        T = camera.T_camera_world.clone()
        T[:3, 3] *= factor
        return dataclasses.replace(camera, T_camera_world=T)

    return farther


MISTAKES = (
    Mistake(
        "half_pixel_shift",
        "the principal point is half a pixel off: pixel centres were taken for whole numbers, or twice not",
        (_shifted(-0.5), _shifted(0.5)),
    ),
    Mistake("flipped_y", "the image is upside down: rows are counted from below", (_flipped,)),
    Mistake("transposed_rotation", "the rotation is transposed: rows for columns", (_transposed,)),
    Mistake(
        "principal_point_sign",
        "the principal point lies on the other side of the image's middle",
        (_mirrored_principal_point(0, 1), _mirrored_principal_point(0), _mirrored_principal_point(1)),
    ),
    Mistake(
        "focal_axis",
        "the focal length, or the angle of view, is that of the other axis",
        (
            _focal_of_other_axis,
            lambda camera: _angle_of_other_axis(camera, True),
            lambda camera: _angle_of_other_axis(camera, False),
        ),
    ),
    Mistake("camera_to_world", "the extrinsics are camera to world: invert them", (_inverted,)),
    Mistake(
        "centimetres", "lengths are centimetres for metres, or the reverse", (_farther(100.0), _farther(0.01))
    ),
)
