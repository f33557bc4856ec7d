"""Gaussians to images: one function, several backends with the same meaning."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.errors import CaptureError, ConfigError
from dsar.raster.conventions import EPS_2D
from dsar.raster.reference import rasterize_reference
from dsar.types import Camera, Gaussians, RenderOutput

__all__ = ["rasterize", "reduced_dilation"]


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Float[Tensor, "3"] | None = None,
    directions: Float[Tensor, "n 3"] | None = None,
    dilation: float = EPS_2D,
    backend: Literal["auto", "reference", "cpu"] = "auto",
) -> RenderOutput:
    """Blend Gaussians front to back into colour, alpha and depth (3D Gaussian Splatting, as gsplat 1.5.3).

    A Gaussian is left out, and gets zero gradients, if its centre is behind the camera or nearer than 0.01 m,
    if its opacity is below 1/255, if a scale is not positive, or if anything about it is not finite.

    Args:
        gaussians: in the world, physical values; quaternions are normalised here.
        camera: OpenCV pinhole without skew. Gets gradients from the reference backend only.
        background: sRGB that shows through the transmittance left over; by default black.
        directions: unit directions in which the harmonics are evaluated (an avatar's are those of its
            canonical pose); by default from the camera's centre to each mean in the world.
        dilation: pixels² added to both diagonal entries of the image-plane covariance; see `reduced_dilation`
            for images that are compared with block averages of larger ones.
        backend: `cpu` (Numba, float32), `reference` (plain torch, any dtype and device, 20 times slower), or
            `auto`: `cpu` for float32 tensors in main memory, else `reference`.

    Returns:
        The image, differentiable by all Gaussian fields, `directions` and `background`.

    Raises:
        ConfigError: the tensors do not fit the backend, or the number of harmonics is none of 1, 4, 9, 16.
        CaptureError: the camera has skew, no positive focal length or no pixels.
    """
    _check_camera(camera)
    _check_tensors(gaussians, background, directions)
    fits_kernels = gaussians.means.dtype == torch.float32 and gaussians.means.device.type == "cpu"
    wants_camera_gradient = camera.K.requires_grad or camera.T_camera_world.requires_grad
    if backend == "reference" or (backend == "auto" and not fits_kernels):
        return rasterize_reference(gaussians, camera, background, directions, dilation)
    if not fits_kernels:
        found = f"{gaussians.means.dtype} on {gaussians.means.device}"
        raise ConfigError(f"rasterize: the cpu backend takes float32 tensors in main memory, not {found}")
    if wants_camera_gradient:
        raise ConfigError("rasterize: the cpu backend has no camera gradients; use backend='reference'")
    # Here, not above: importing the kernels takes a while, and reference users need none.
    from dsar.raster.cpu import rasterize_cpu

    return rasterize_cpu(gaussians, camera, background, directions, dilation)


def reduced_dilation(factor: int) -> float:
    """Return the dilation with which an image of 1/factor of the size equals block averages of the whole one.

    Averaging blocks of n x n pixels adds (n² - 1) / 12 pixels² to a splat's variance. With the usual dilation
    Gaussians fitted to small images come out too small for large ones (Yu et al. 2024, Mip-Splatting).
    """
    return (EPS_2D + (factor**2 - 1) / 12) / factor**2


def _check_camera(camera: Camera) -> None:
    """Refuse a camera that is not a plain pinhole."""
    (fx, skew, _), (shear, fy, _), bottom = camera.K.tolist()
    if skew != 0 or shear != 0 or bottom != [0, 0, 1] or not (fx > 0 and fy > 0):
        raise CaptureError(
            f"camera {camera.name!r}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0, found "
            f"{camera.K.tolist()}; undistort and rectify the images first"
        )
    if camera.width < 1 or camera.height < 1:
        raise CaptureError(f"camera {camera.name!r}: its image has {camera.width} x {camera.height} pixels")


def _check_tensors(gaussians: Gaussians, background: Tensor | None, directions: Tensor | None) -> None:
    """Refuse tensors that do not belong together."""
    count = gaussians.harmonics.shape[1]
    if count not in (1, 4, 9, 16):
        raise ConfigError(
            f"rasterize: harmonics come in 1, 4, 9 or 16 coefficients (degree 0-3), not {count}"
        )
    if directions is not None and directions.shape != gaussians.means.shape:
        raise ConfigError(
            f"rasterize: directions are {tuple(directions.shape)}, expected {tuple(gaussians.means.shape)}: "
            "one per Gaussian"
        )
    means = gaussians.means
    others = (
        gaussians.rotations,
        gaussians.scales,
        gaussians.opacities,
        gaussians.harmonics,
        background,
        directions,
    )
    for tensor in others:
        if tensor is not None and (tensor.dtype != means.dtype or tensor.device != means.device):
            raise ConfigError(
                f"rasterize: tensors differ: {means.dtype} on {means.device} and {tensor.dtype} on "
                f"{tensor.device}; bring all to one dtype and device"
            )
