"""The backends of the rasteriser, and which one draws."""

from collections.abc import Collection
from typing import Literal, Protocol, get_args, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.errors import ConfigError
from dsar.types import Camera, Gaussians, RenderOutput

Backend = Literal["auto", "cpu", "cuda", "reference"]
Output = Literal["median_depth", "first_hit_depth", "largest_weight_id", "contributors"]
OUTPUTS: tuple[Output, ...] = get_args(Output)


@runtime_checkable
class Rasterizer(Protocol):
    """What every backend is: `dsar.raster.rasterize` without its checks."""

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


def load_backend(backend: Backend, means: Tensor, camera: Camera) -> Rasterizer:
    """Return the rasteriser that draws these Gaussians.

    Raises:
        ConfigError: The backend does not suit the tensors or the camera.
    """
    # Imported where they are wanted: kernels take a while to load, and reference users need none.
    match _choose_backend(backend, means, camera):
        case "cpu":
            from dsar.raster.cpu import rasterize_cpu

            return rasterize_cpu
        case "cuda":
            from dsar.raster.cuda import rasterize_cuda

            return rasterize_cuda
        case _:
            from dsar.raster.reference import rasterize_reference

            return rasterize_reference


def _choose_backend(backend: Backend, means: Tensor, camera: Camera) -> Backend:
    """Return the fast backend of the tensors' device for float32, the reference for all else."""
    device = means.device.type
    if backend == "auto":
        backend = device if means.dtype == torch.float32 and device in ("cpu", "cuda") else "reference"
    if backend == "reference":
        return backend
    if means.dtype != torch.float32 or device != backend:
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
