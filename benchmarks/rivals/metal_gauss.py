"""metal-gauss's plain torch rasteriser (MIT), the one that its Metal kernels are checked against."""

import warnings

import torch
from metal_gauss import torch_ref

from dsar.types import Camera, Gaussians
from rivals import TorchScene

# Its early stop reads a tensor that autograd follows.
warnings.filterwarnings("ignore", "Converting a tensor with requires_grad=True to a scalar")


def prepare(gaussians: Gaussians, camera: Camera, threads: int) -> TorchScene:
    """Return the scene as metal-gauss draws it."""
    return TorchScene(_render, gaussians, camera)


def _render(gaussians: Gaussians, camera: Camera) -> torch.Tensor:
    # Its default of 32 tiles of 32 x 32 pixels at a time is several times slower on a CPU.
    image, _, _ = torch_ref.render(
        gaussians.means,
        gaussians.rotations,
        gaussians.scales,
        gaussians.opacities,
        gaussians.harmonics,
        camera.K,
        camera.T_camera_world,
        camera.width,
        camera.height,
        sh_degree=round(gaussians.harmonics.shape[1] ** 0.5) - 1,
        tile=16,
        tile_chunk=2,
        slab=128,
    )
    return image
