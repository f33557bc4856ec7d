"""The usual mistakes in cameras, in one catalogue.

A calibration that was made with one of them is mended by the change that undoes it (`CALIBRATION_FAULTS`, for
`dsar check`); a correct camera becomes a wrong one by a change that makes it (`PROJECTION_FAULTS`, for
`dsar crosscheck`).
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.geometry.cameras import project
from dsar.types import Camera

CameraChange = Callable[[Camera], Camera]


@dataclass(frozen=True)
class CameraFault:
    """A mistake that people or programs make with cameras."""

    name: str
    """A word for it, stable: written into reports."""
    description: str
    """The same for people, with the remedy where it is known."""
    changes: tuple[CameraChange, ...]
    """They undo it in `CALIBRATION_FAULTS`, and make it in `PROJECTION_FAULTS`."""
    in_file_world: bool = False
    """Whether it is undone in the world of the capture's files, before that is turned upright."""


def invert_extrinsics(camera: Camera) -> Camera:
    """Return a camera whose extrinsics are the inverse."""
    return _with_extrinsics(camera, torch.linalg.inv(camera.T_camera_world.double()))


def transpose_rotation(camera: Camera) -> Camera:
    """Return a camera whose rotation is transposed; its translation stays."""
    T = camera.T_camera_world
    return _with_extrinsics(camera, _rigid(T[:3, :3].T, T[:3, 3]))


def translation_from_center(camera: Camera) -> Camera:
    """Return a camera whose translation is -R c, where it was the camera's centre c."""
    T = camera.T_camera_world
    return _with_extrinsics(camera, _rigid(T[:3, :3], -T[:3, :3] @ T[:3, 3]))


def flip_axes(x: float, y: float, z: float) -> CameraChange:
    """Return the change of the signs of a camera's axes, each 1 or -1."""
    return lambda camera: _with_extrinsics(
        camera, torch.diag(torch.tensor([x, y, z, 1.0])) @ camera.T_camera_world
    )


def scale_translation(factor: float) -> CameraChange:
    """Return the change of the unit of a camera's translation."""

    def change(camera: Camera) -> Camera:
        T = camera.T_camera_world.clone()
        T[:3, 3] *= factor
        return _with_extrinsics(camera, T)

    return change


def scale_intrinsics(factor: float) -> CameraChange:
    """Return the change of intrinsics to those of images `factor` times as large."""
    return lambda camera: dataclasses.replace(
        camera, K=camera.K * torch.tensor([[factor], [factor], [1.0]]).to(camera.K)
    )


def shift_principal_point(x: float, y: float) -> CameraChange:
    """Return the move of the principal point by pixels."""
    return lambda camera: _with_K(camera, lambda K: K[:2, 2].add_(torch.tensor([x, y]).to(K)))


def mirror_image(*axes: int) -> CameraChange:
    """Return the mirroring of the image: along axis 0 left to right, along axis 1 top to bottom."""

    def change(camera: Camera) -> Camera:
        def mirror(K: Tensor) -> None:
            for axis in axes:
                size = (camera.width, camera.height)[axis]
                K[axis] = torch.tensor([0.0, 0.0, size]).to(K) - K[axis]

        return _with_K(camera, mirror)

    return change


def mirror_principal_point(*axes: int) -> CameraChange:
    """Return the mirroring of the principal point alone, about the image's middle."""

    def change(camera: Camera) -> Camera:
        def mirror(K: Tensor) -> None:
            for axis in axes:
                K[axis, 2] = (camera.width, camera.height)[axis] - K[axis, 2]

        return _with_K(camera, mirror)

    return change


def swap_focal_lengths(camera: Camera) -> Camera:
    """Return a camera whose focal lengths fx and fy are exchanged."""

    def swap(K: Tensor) -> None:
        K[0, 0], K[1, 1] = K[1, 1].clone(), K[0, 0].clone()

    return _with_K(camera, swap)


def field_of_view_of_other_axis(*, wide: bool) -> CameraChange:
    """Return the change by which one axis' angle of view is taken for the other's."""

    def change(camera: Camera) -> Camera:
        aspect = camera.width / camera.height

        def scale(K: Tensor) -> None:
            K[[0, 1], [0, 1]] *= aspect if wide else 1 / aspect

        return _with_K(camera, scale)

    return change


def _with_K(camera: Camera, change: Callable[[Tensor], object]) -> Camera:
    K = camera.K.clone()
    change(K)
    return dataclasses.replace(camera, K=K)


def _with_extrinsics(camera: Camera, T_camera_world: Float[Tensor, "4 4"]) -> Camera:
    return dataclasses.replace(camera, T_camera_world=T_camera_world.to(camera.T_camera_world))


def _rigid(rotation: Float[Tensor, "3 3"], translation: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    transform = torch.eye(4).to(rotation)
    transform[:3, :3], transform[:3, 3] = rotation, translation
    return transform


_UNITS = ((1e-3, "millimetres"), (1e-2, "centimetres"), (1e3, "kilometres"))
_AXES = (
    ("opengl_axes", (1.0, -1.0, -1.0), "OpenGL's (y up, looking along -z): negate the rows of y and z"),
    (
        "pytorch3d_axes",
        (-1.0, -1.0, 1.0),
        "PyTorch3D's or Mitsuba's (x left, y up): negate the rows of x and y",
    ),
    ("mirrored_axes", (-1.0, 1.0, -1.0), "turned about y: negate the rows of x and z"),
)

CALIBRATION_FAULTS: tuple[CameraFault, ...] = (
    CameraFault(
        "camera_to_world",
        "the extrinsics are camera to world: invert them",
        (invert_extrinsics,),
        in_file_world=True,
    ),
    CameraFault(
        "rotation_transposed",
        "the cameras' rotations are transposed (rows for columns, or camera to world beside a "
        "world-to-camera translation): transpose them",
        (transpose_rotation,),
        in_file_world=True,
    ),
    CameraFault(
        "camera_centers",
        "the translations are the cameras' places: use -R times the place",
        (translation_from_center,),
        in_file_world=True,
    ),
    *(
        CameraFault(name, f"the cameras' axes are {convention}", (flip_axes(*signs),))
        for name, signs, convention in _AXES
    ),
    *(
        CameraFault(
            f"cameras_in_{unit}",
            f"the cameras' translations look like {unit}: divide them by {1 / factor:g}",
            (scale_translation(factor),),
        )
        for factor, unit in _UNITS
    ),
    *(
        CameraFault(
            f"intrinsics_times_{1 / factor:g}",
            f"K is of images {1 / factor:g} times as large: multiply its first two rows by {factor:g}",
            (scale_intrinsics(factor),),
        )
        for factor in (0.25, 0.5, 2.0, 4.0)
    ),
    CameraFault(
        "mirrored_images",
        "the images are mirrored left to right: mirror them back",
        (mirror_image(0),),
    ),
    CameraFault(
        "upside_down",
        "the images are upside down: turn them by 180 degrees",
        (mirror_image(0, 1),),
    ),
)
"""What calibrations get wrong and small images show; `changes` undo it."""

HALF_PIXEL_FAULTS: tuple[CameraFault, ...] = tuple(
    CameraFault(
        f"half_pixel_{pixels:+.1f}",
        f"the principal points are half a pixel off: the calibration has pixel centres at {remedy}",
        (shift_principal_point(pixels, pixels),),
    )
    for pixels, remedy in (
        (0.5, "whole numbers; add half a pixel"),
        (-0.5, "halves already; take half a pixel off"),
    )
)
"""What calibrations get wrong and only images of full size show; `changes` undo it."""

PROJECTION_FAULTS: tuple[CameraFault, ...] = (
    CameraFault(
        "half_pixel_shift",
        "the principal point is half a pixel off: pixel centres were taken for whole numbers, or twice not",
        (shift_principal_point(-0.5, -0.5), shift_principal_point(0.5, 0.5)),
    ),
    CameraFault("flipped_y", "the image is upside down: rows are counted from below", (mirror_image(1),)),
    CameraFault("transposed_rotation", "the rotation is transposed: rows for columns", (transpose_rotation,)),
    CameraFault(
        "principal_point_sign",
        "the principal point lies on the other side of the image's middle",
        (mirror_principal_point(0, 1), mirror_principal_point(0), mirror_principal_point(1)),
    ),
    CameraFault(
        "focal_axis",
        "the focal length, or the angle of view, is that of the other axis",
        (
            swap_focal_lengths,
            field_of_view_of_other_axis(wide=True),
            field_of_view_of_other_axis(wide=False),
        ),
    ),
    CameraFault("camera_to_world", "the extrinsics are camera to world: invert them", (invert_extrinsics,)),
    CameraFault(
        "centimetres",
        "lengths are centimetres for metres, or the reverse",
        (scale_translation(100.0), scale_translation(0.01)),
    ),
)
"""What programs get wrong that write, read or draw a camera; `changes` make it."""


def explain_projection(
    camera: Camera, points: Float[Tensor, "n 3"], pixels: Float[Tensor, "n 2"], tolerance: float
) -> CameraFault | None:
    """Return the fault that explains why points are seen elsewhere than through a camera.

    Args:
        camera: The correct one.
        points: World metres.
        pixels: Where the questionable camera has them; those that are not finite are left out.
        tolerance: Root mean square of the pixels that are still explained.
    """
    finite = pixels.isfinite().all(-1)
    if finite.sum() < 4:
        return None
    best: tuple[float, CameraFault] | None = None
    for fault in PROJECTION_FAULTS:
        for change in fault.changes:
            projected, _ = project(change(camera), points[finite])
            error = float((projected - pixels[finite]).square().sum(-1).mean().sqrt())
            if error <= tolerance and (best is None or error < best[0]):
                best = error, fault
    return best[1] if best else None
