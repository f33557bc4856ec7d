"""What a rasteriser asks of its input before it draws."""

import math
from collections.abc import Collection, Sequence

from torch import Tensor

from dsar.errors import CaptureError, ConfigError
from dsar.raster.backends import OUTPUTS
from dsar.types import Camera, Gaussians


def check_inputs(
    gaussians: Sequence[Gaussians],
    cameras: Sequence[Sequence[Camera]],
    backgrounds: Tensor | None,
    dilation: float,
    outputs: Collection[str],
) -> None:
    """Check the arguments of `dsar.raster.rasterize_views`.

    Raises:
        ConfigError: The tensors do not fit each other, or a setting is not usable.
        CaptureError: A camera has skew, no positive focal length, no pixels, or values that are not finite.
    """
    if len(gaussians) != len(cameras):
        raise ConfigError(
            f"rasterize: {len(gaussians)} sets of Gaussians have {len(cameras)} lists of cameras; give each "
            "set the cameras that see it"
        )
    for views in cameras:
        for camera in views:
            _check_camera(camera)
    for group in gaussians:
        _check_tensors(group, gaussians[0])
    if backgrounds is not None and gaussians:
        _check_backgrounds(backgrounds, sum(map(len, cameras)), gaussians[0].means)
    check_outputs(outputs)
    if not 0 < dilation < math.inf:
        raise ConfigError(f"rasterize: dilation must be positive and finite (pixels²), found {dilation}")


def _check_camera(camera: Camera) -> None:
    """Raise CaptureError where a camera is not a plain pinhole."""
    # As lists: on so few numbers Python is faster than torch.
    K, transform = camera.K.tolist(), camera.T_camera_world.tolist()
    (fx, skew, _), (shear, fy, _), bottom = K
    if skew != 0 or shear != 0 or bottom != [0, 0, 1] or not (fx > 0 and fy > 0):
        raise CaptureError(
            f"camera {camera.name!r}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0, found "
            f"{K}; undistort and rectify the images first"
        )
    if not all(math.isfinite(value) for row in (*K, *transform) for value in row):
        raise CaptureError(f"camera {camera.name!r}: K or T_camera_world holds values that are not finite")
    if camera.width < 1 or camera.height < 1:
        raise CaptureError(f"camera {camera.name!r}: its image has {camera.width} x {camera.height} pixels")


def check_outputs(outputs: Collection[str]) -> None:
    """Check that outputs exist.

    Raises:
        ConfigError: One does not.
    """
    unknown = sorted(set(outputs) - set(OUTPUTS))
    if unknown:
        raise ConfigError(f"rasterize: outputs can be {', '.join(OUTPUTS)}; found {', '.join(unknown)}")


def _check_tensors(gaussians: Gaussians, first: Gaussians) -> None:
    """Raise ConfigError where tensors do not belong together, or not with those of the first set."""
    n, count = len(gaussians), gaussians.harmonics.shape[1]
    if count not in (1, 4, 9, 16):
        raise ConfigError(
            f"rasterize: harmonics come in 1, 4, 9 or 16 coefficients (degree 0-3), not {count}"
        )
    if count != first.harmonics.shape[1]:
        raise ConfigError(
            f"rasterize: sets of one call have equally many harmonics, found {first.harmonics.shape[1]} "
            f"and {count}"
        )
    shapes = {
        "means": (n, 3), "rotations": (n, 4), "scales": (n, 3), "opacities": (n,), "harmonics": (n, count, 3),
    }  # fmt: skip
    for name, tensor in vars(gaussians).items():
        if tensor.shape != shapes[name]:
            raise ConfigError(f"rasterize: {name} must be {shapes[name]}, found {tuple(tensor.shape)}")
        if tensor.dtype != first.means.dtype or tensor.device != first.means.device:
            raise ConfigError(
                f"rasterize: tensors differ: {first.means.dtype} on {first.means.device} and {tensor.dtype} "
                f"on {tensor.device}; bring all to one dtype and device"
            )


def _check_backgrounds(backgrounds: Tensor, views: int, means: Tensor) -> None:
    """Raise ConfigError where there is not one colour a view, of the Gaussians' dtype."""
    if backgrounds.shape != (views, 3):
        raise ConfigError(
            f"rasterize: {views} views have backgrounds of shape {(views, 3)}, "
            f"found {tuple(backgrounds.shape)}"
        )
    if backgrounds.dtype != means.dtype:
        raise ConfigError(
            f"rasterize: backgrounds are {backgrounds.dtype}, Gaussians {means.dtype}; "
            "bring both to one dtype"
        )
