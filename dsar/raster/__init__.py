"""Gaussians to images: one function, several backends with the same meaning."""

import math
from collections.abc import Collection
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.errors import CaptureError, ConfigError
from dsar.raster.conventions import EPS_2D
from dsar.types import Camera, Gaussians, RenderOutput

__all__ = ["Backend", "Output", "rasterize", "reduced_dilation"]

Backend = Literal["auto", "cpu", "cuda", "reference"]
Output = Literal["median_depth", "first_hit_depth", "largest_weight_id", "contributors"]


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Float[Tensor, "3"] | None = None,
    dilation: float = EPS_2D,
    antialiased: bool = False,
    backend: Backend = "auto",
    outputs: Collection[Output] = (),
) -> RenderOutput:
    """Blend Gaussians front to back into colour, alpha and depth (3D Gaussian Splatting, as gsplat 1.5.3).

    A Gaussian is left out, and gets zero gradients, if its centre is behind the camera or nearer than 0.01 m,
    if its opacity is below 1/255, if a scale is not positive, if anything about it is not finite, or if it
    reaches no pixel; `RenderOutput.culled` counts them.

    Args:
        gaussians: in the world, physical values; quaternions are normalised here.
        camera: OpenCV pinhole without skew. Gets gradients from the reference backend only.
        background: sRGB that shows through the transmittance left over; by default black.
        dilation: pixels² added to both diagonal entries of the image-plane covariance; see `reduced_dilation`
            for images that are compared with block averages of larger ones.
        antialiased: lower opacities by what dilation adds in area, so that splats smaller than a pixel do not
            thicken as the camera moves away (Yu et al. 2024, Mip-Splatting).
        backend: `cpu` (Numba, float32), `cuda` (gsplat, float32), `reference` (plain torch, any dtype and
            device, a hundred times slower), or `auto`: for float32 the fast one where the tensors are, else
            `reference`.
        outputs: what to compute besides colour, alpha and expected depth.

    Returns:
        The image, differentiable by all Gaussian fields and `background`.

    Raises:
        ConfigError: the tensors do not fit each other or the backend, or a setting is not usable.
        CaptureError: the camera has skew, no positive focal length, no pixels, or values that are not finite.
        RasterError: Gaussians are so large that their list of tiles would not fit into memory.
    """
    _check_camera(camera)
    _check_tensors(gaussians, background)
    _check_outputs(outputs)
    if not 0 < dilation < math.inf:
        raise ConfigError(f"rasterize: dilation must be positive and finite (pixels²), found {dilation}")
    chosen = _choose_backend(backend, gaussians.means, camera)
    # Imported where they are wanted: kernels take a while to load, and reference users need none.
    if chosen == "cpu":
        from dsar.raster.cpu import rasterize_cpu as rasterize_with
    elif chosen == "cuda":
        from dsar.raster.cuda import rasterize_cuda as rasterize_with
    else:
        from dsar.raster.reference import rasterize_reference as rasterize_with
    return rasterize_with(gaussians, camera, background, dilation, antialiased, outputs)


def reduced_dilation(factor: int) -> float:
    """Return the dilation with which an image of 1/factor of the size equals block averages of the whole one.

    Averaging blocks of n x n pixels adds (n² - 1) / 12 pixels² to a splat's variance. With the usual dilation
    Gaussians fitted to small images come out too small for large ones (Yu et al. 2024, Mip-Splatting).
    """
    return (EPS_2D + (factor**2 - 1) / 12) / factor**2


def _choose_backend(backend: Backend, means: Tensor, camera: Camera) -> Backend:
    """Return the backend to take; refuse one that does not suit tensors or camera."""
    place = means.device.type
    if backend == "auto":
        backend = place if means.dtype == torch.float32 and place in ("cpu", "cuda") else "reference"
    if backend == "reference":
        return backend
    if means.dtype != torch.float32 or place != backend:
        where = "on a GPU" if backend == "cuda" else "in main memory"
        raise ConfigError(
            f"rasterize: the {backend} backend takes float32 tensors {where}, "
            f"not {means.dtype} on {means.device}"
        )
    if camera.K.requires_grad or camera.T_camera_world.requires_grad:
        raise ConfigError(
            f"rasterize: the {backend} backend has no camera gradients; use backend='reference'"
        )
    return backend


def _check_camera(camera: Camera) -> None:
    """Refuse a camera that is not a plain pinhole."""
    (fx, skew, _), (shear, fy, _), bottom = camera.K.tolist()
    if skew != 0 or shear != 0 or bottom != [0, 0, 1] or not (fx > 0 and fy > 0):
        raise CaptureError(
            f"camera {camera.name!r}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0, found "
            f"{camera.K.tolist()}; undistort and rectify the images first"
        )
    if not (camera.K.isfinite().all() and camera.T_camera_world.isfinite().all()):
        raise CaptureError(f"camera {camera.name!r}: K or T_camera_world holds values that are not finite")
    if camera.width < 1 or camera.height < 1:
        raise CaptureError(f"camera {camera.name!r}: its image has {camera.width} x {camera.height} pixels")


def _check_outputs(outputs: Collection[str]) -> None:
    """Refuse outputs that do not exist."""
    unknown = sorted(set(outputs) - set(get_args(Output)))
    if unknown:
        raise ConfigError(
            f"rasterize: outputs can be {', '.join(get_args(Output))}; found {', '.join(unknown)}"
        )


def _check_tensors(gaussians: Gaussians, background: Tensor | None) -> None:
    """Refuse tensors that do not belong together."""
    n, count = len(gaussians), gaussians.harmonics.shape[1]
    if count not in (1, 4, 9, 16):
        raise ConfigError(
            f"rasterize: harmonics come in 1, 4, 9 or 16 coefficients (degree 0-3), not {count}"
        )
    shapes = {
        "means": (n, 3), "rotations": (n, 4), "scales": (n, 3), "opacities": (n,), "harmonics": (n, count, 3),
        "background": (3,),
    }  # fmt: skip
    means, tensors = gaussians.means, {**vars(gaussians), "background": background}
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        if tensor.shape != shapes[name]:
            raise ConfigError(f"rasterize: {name} must be {shapes[name]}, found {tuple(tensor.shape)}")
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise ConfigError(
                f"rasterize: tensors differ: {means.dtype} on {means.device} and {tensor.dtype} on "
                f"{tensor.device}; bring all to one dtype and device"
            )
