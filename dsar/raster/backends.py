"""The backends of the rasteriser, and which one draws."""

from collections.abc import Collection, Sequence
from importlib.util import find_spec
from typing import Literal, Protocol, get_args, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.errors import ConfigError, MissingDependencyError
from dsar.types import Camera, Gaussians, RenderOutput

Backend = Literal["auto", "cpu", "warp", "gsplat", "reference"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)
Output = Literal["median_depth", "first_hit_depth", "largest_weight_id", "contributors"]
OUTPUTS: tuple[Output, ...] = get_args(Output)

_DEVICES = {"cpu": ("cpu",), "warp": ("cpu", "cuda"), "gsplat": ("cuda",)}
"""Types of the devices on which a backend draws; the reference draws on any."""


@runtime_checkable
class Rasterizer(Protocol):
    """What every backend is: `dsar.raster.rasterize_views` without its checks."""

    def __call__(
        self,
        gaussians: Sequence[Gaussians],
        cameras: Sequence[Sequence[Camera]],
        backgrounds: Float[Tensor, "v 3"] | None,
        dilation: float,
        antialiased: bool,
        outputs: Collection[str],
    ) -> list[list[RenderOutput]]:
        """Return the images."""
        ...


@runtime_checkable
class ViewRasterizer(Protocol):
    """A backend that draws one view at a time."""

    def __call__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Float[Tensor, "3"] | None,
        dilation: float,
        antialiased: bool,
        outputs: Collection[str],
    ) -> RenderOutput:
        """Return the image."""
        ...


def load_backend(
    backend: Backend, gaussians: Sequence[Gaussians], cameras: Sequence[Sequence[Camera]]
) -> Rasterizer:
    """Return the rasteriser that draws these Gaussians.

    Raises:
        ConfigError: The backend does not suit the tensors or the cameras.
        MissingDependencyError: It is not installed, or no backend for the GPU is.
    """
    # Imported where they are wanted: kernels take a while to load, and reference users need none.
    match _choose_backend(backend, gaussians[0].means, cameras):
        case "cpu":
            from dsar.raster.cpu import rasterize_cpu

            return _one_by_one(rasterize_cpu)
        case "warp":
            if find_spec("warp") is None:
                raise MissingDependencyError("the warp backend of rasterize", "warp-lang", "gpu")
            from dsar.raster.warp_backend import rasterize_views_warp

            return rasterize_views_warp
        case "gsplat":
            from dsar.raster.gsplat_backend import rasterize_gsplat

            return _one_by_one(rasterize_gsplat)
        case _:
            from dsar.raster.reference import rasterize_reference

            return _one_by_one(rasterize_reference)


def _one_by_one(draw: ViewRasterizer) -> Rasterizer:
    """Return a rasteriser of batches that draws view after view."""

    def draw_views(
        gaussians: Sequence[Gaussians],
        cameras: Sequence[Sequence[Camera]],
        backgrounds: Float[Tensor, "v 3"] | None,
        dilation: float,
        antialiased: bool,
        outputs: Collection[str],
    ) -> list[list[RenderOutput]]:
        colors = iter(backgrounds) if backgrounds is not None else None
        return [
            [
                draw(group, camera, next(colors) if colors else None, dilation, antialiased, outputs)
                for camera in views
            ]
            for group, views in zip(gaussians, cameras, strict=True)
        ]

    return draw_views


def _choose_backend(backend: Backend, means: Tensor, cameras: Sequence[Sequence[Camera]]) -> Backend:
    """Return the fast backend of the tensors' device for float32, the reference for all else."""
    if backend not in BACKENDS:
        raise ConfigError(f"rasterize: backend can be {', '.join(BACKENDS)}; found {backend}")
    device = means.device.type
    if backend == "auto":
        backend = _fast_backend(device) if means.dtype == torch.float32 else "reference"
    if backend == "reference":
        return backend
    if means.dtype != torch.float32 or device not in _DEVICES[backend]:
        where = {"cpu": "in main memory", "gsplat": "on a GPU", "warp": "in main memory or on a GPU"}[backend]
        raise ConfigError(
            f"rasterize: the {backend} backend takes float32 tensors {where}, "
            f"not {means.dtype} on {means.device}"
        )
    if any(c.K.requires_grad or c.T_camera_world.requires_grad for views in cameras for c in views):
        raise ConfigError(
            f"rasterize: the {backend} backend has no camera gradients; use backend='reference'"
        )
    return backend


def _fast_backend(device: str) -> Backend:
    """Return the installed fast backend for a type of device; the reference where none is made for it.

    Raises:
        MissingDependencyError: None of those for an NVIDIA GPU is installed.
    """
    if device != "cuda":
        return "cpu" if device == "cpu" else "reference"
    if find_spec("warp") is not None:
        return "warp"
    if find_spec("gsplat") is not None:
        return "gsplat"
    raise MissingDependencyError("rasterize on a GPU", "warp-lang, which needs no compiler", "gpu")
