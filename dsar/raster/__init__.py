"""Gaussians to images: one function, several backends with the same meaning."""

from collections.abc import Collection, Sequence

from jaxtyping import Float
from torch import Tensor

from dsar.raster.backends import Backend, Output, load_backend
from dsar.raster.checks import check_inputs
from dsar.raster.conventions import EPS_2D
from dsar.types import Camera, Gaussians, RenderOutput

__all__ = ["Backend", "Output", "rasterize", "rasterize_views", "reduced_dilation"]


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
        backend: `cpu` (Numba, float32), `warp` (float32, for NVIDIA GPUs; on the CPU only for tests),
            `gsplat` (float32, NVIDIA GPUs, needs a compiler), `reference` (plain torch, any dtype and device,
            a hundred times slower), or `auto`: for float32 the fast one where the tensors are, `warp` before
            `gsplat`, else `reference`.
        outputs: what to compute besides colour, alpha and expected depth.

    Returns:
        The image, differentiable by all Gaussian fields and `background`.

    Raises:
        ConfigError: the tensors do not fit each other or the backend, or a setting is not usable.
        CaptureError: the camera has skew, no positive focal length, no pixels, or values that are not finite.
        RasterError: Gaussians are so large that their list of tiles would not fit into memory.
        MissingDependencyError: the backend is not installed, or none for the GPU is.
    """
    views = rasterize_views(
        [gaussians],
        [[camera]],
        backgrounds=None if background is None else background[None],
        dilation=dilation,
        antialiased=antialiased,
        backend=backend,
        outputs=outputs,
    )
    return views[0][0]


def rasterize_views(
    gaussians: Sequence[Gaussians],
    cameras: Sequence[Sequence[Camera]],
    *,
    backgrounds: Float[Tensor, "v 3"] | None = None,
    dilation: float = EPS_2D,
    antialiased: bool = False,
    backend: Backend = "auto",
    outputs: Collection[Output] = (),
) -> list[list[RenderOutput]]:
    """Rasterise several sets of Gaussians, each in views of its own, in one call: `rasterize` for a batch.

    `warp` draws all of them at once, which keeps a GPU busy with small images; other backends one by one. The
    meaning is the same: each image equals that of a `rasterize` of its own.

    Args:
        gaussians: the sets, of any sizes, with equally many harmonics.
        cameras: for each set those that see it: any number, images of any sizes.
        backgrounds: one sRGB colour a view, in the order of the cameras.
        dilation: as for `rasterize`, likewise the rest.
        antialiased: see there.
        backend: see there.
        outputs: see there.

    Returns:
        The images of each set, in the order of its cameras.

    Raises:
        ConfigError: as `rasterize`, or sets, cameras and backgrounds are not equally many.
        CaptureError: as `rasterize`.
        RasterError: as `rasterize`.
        MissingDependencyError: as `rasterize`.
    """
    check_inputs(gaussians, cameras, backgrounds, dilation, outputs)
    if not any(cameras):
        return [[] for _ in cameras]
    if backgrounds is not None:
        backgrounds = backgrounds.to(gaussians[0].means.device)
    draw = load_backend(backend, gaussians, cameras)
    return draw(gaussians, cameras, backgrounds, dilation, antialiased, outputs)


def reduced_dilation(factor: int) -> float:
    """Return the dilation with which an image of 1/factor of the size equals block averages of the whole one.

    Averaging blocks of n x n pixels adds (n² - 1) / 12 pixels² to a splat's variance. With the usual dilation
    Gaussians fitted to small images come out too small for large ones (Yu et al. 2024, Mip-Splatting).
    """
    return (EPS_2D + (factor**2 - 1) / 12) / factor**2
