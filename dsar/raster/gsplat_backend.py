"""The optional backend on NVIDIA GPUs: gsplat (Apache-2.0) behind the same signature, float32.

gsplat is imported at the first image, and compiles its kernels at the first ever (minutes, with nvcc). Its
constants are those of dsar.raster.conventions; its version is pinned, because 1.6 changed some of them. It
adds up gradients in whatever order its threads arrive, so they are not the same to the bit from run to run.
It counts as drawn what only its bounding box brings into the image.
"""

from collections.abc import Collection
from functools import cache
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dsar.errors import ConfigError, MissingDependencyError
from dsar.raster.contributors import find_first_hit_depth, find_largest_weight_id
from dsar.raster.conventions import ALPHA_MAX, NEAR
from dsar.raster.reference import rasterize_reference
from dsar.types import Camera, Contributors, Gaussians, RenderOutput


def rasterize_gsplat(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Tensor, "3"] | None,
    dilation: float,
    antialiased: bool,
    outputs: Collection[str],
) -> RenderOutput:
    """Rasterise with gsplat: `dsar.raster.rasterize` without its checks, for float32 on a GPU.

    Raises:
        ConfigError: there is no GPU, or gsplat cannot build or load its kernels.
        MissingDependencyError: gsplat is not installed or does not import.
    """
    if not len(gaussians):
        return rasterize_reference(gaussians, camera, background, dilation, antialiased, outputs)
    gsplat = _load_gsplat()
    valid = _hide_invalid(gaussians)
    image, alpha, meta = gsplat.rasterization(
        valid.means,
        valid.rotations,
        valid.scales,
        valid.opacities,
        valid.harmonics,
        camera.T_camera_world.to(valid.means)[None],
        camera.K.to(valid.means)[None],
        camera.width,
        camera.height,
        near_plane=NEAR,
        eps2d=dilation,
        sh_degree=round(valid.harmonics.shape[1] ** 0.5) - 1,
        packed=False,
        render_mode="RGB+ED",
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    color, depth, alpha = image[0, ..., :3], image[0, ..., 3], alpha[0, ..., 0]
    if background is not None:
        color = color + (1 - alpha[..., None]) * background
    visible = (meta["radii"][0] > 0).all(-1).sum()
    extras: dict[str, Any] = {}
    if outputs:
        contributors, before = _find_contributors(gsplat, meta, camera)
        depths = meta["depths"][0].detach()
        compute = {
            "median_depth": lambda: _median_depth(contributors, before, depths),
            "first_hit_depth": lambda: find_first_hit_depth(contributors, depths),
            "largest_weight_id": lambda: find_largest_weight_id(contributors),
            "contributors": lambda: contributors,
        }
        extras = {name: compute[name]() for name in outputs}
    return RenderOutput(color, alpha, depth, len(gaussians) - visible, **extras)


@cache
def _load_gsplat() -> Any:
    """Return the gsplat module, or say what is missing."""
    # Before the import, which on a machine without a GPU fails in ways that differ from one to the next.
    if not torch.cuda.is_available():
        raise ConfigError(
            "rasterize: the gsplat backend needs an NVIDIA GPU and a CUDA build of torch; none found"
        )
    try:
        import gsplat  # pyright: ignore[reportMissingImports]  # not where CI runs
        from gsplat.cuda._backend import _C  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        if error.name != "gsplat":
            raise _broken(error) from error
        raise MissingDependencyError("the gsplat backend of rasterize", "gsplat", "gsplat") from error
    # Without its kernels, gsplat fails in whatever line first wants them; a compiler's failure comes through
    # torch as RuntimeError.
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        raise _broken(error) from error
    if _C is None:
        raise _broken("it found no CUDA toolkit")
    return gsplat


def _broken(reason: object) -> ConfigError:
    """Return the error that says why gsplat is here and does not draw, and what to do."""
    first = next(iter(str(reason).splitlines()), "") or repr(reason)
    return ConfigError(
        f"rasterize: gsplat could not build or load its kernels ({first}); it needs nvcc of CUDA "
        f"{torch.version.cuda} on PATH or in CUDA_HOME, a C++ compiler and ninja. "
        "pip install 'dsar-avatar[gpu]' brings Warp, which needs none of them (backend='warp')"
    )


def _hide_invalid(gaussians: Gaussians) -> Gaussians:
    """Return the same Gaussians, those that cannot be drawn replaced by a transparent one.

    gsplat would blend what is not finite or has no size; were they taken out, the GPU would have to wait for
    their number.
    """
    norms = gaussians.rotations.norm(dim=-1)
    is_valid = (gaussians.scales > 0).all(-1) & (norms > 0) & norms.isfinite()
    for values in vars(gaussians).values():
        is_valid &= values.detach().isfinite().reshape(len(values), -1).all(-1)

    def replace(values: Tensor, substitute: float) -> Tensor:
        return torch.where(is_valid.view(-1, *[1] * (values.ndim - 1)), values, substitute)

    return Gaussians(
        replace(gaussians.means, 0.0),
        replace(gaussians.rotations, 1.0),
        replace(gaussians.scales, 1.0),
        replace(gaussians.opacities, 0.0),
        replace(gaussians.harmonics, 0.0),
    )


@torch.no_grad()
def _find_contributors(
    gsplat: Any, meta: dict[str, Any], camera: Camera
) -> tuple[Contributors, Float[Tensor, " m"]]:
    """Return every pixel's Gaussians and weights, and the transmittance in front of each."""
    width, height = camera.width, camera.height
    means, conics, opacities = (meta[name].detach() for name in ("means2d", "conics", "opacities"))
    ids, pixels, _ = gsplat.rasterize_to_indices_in_range(
        0, 2**31 - 1, means.new_ones(1, height, width), means, conics, opacities.contiguous(), width, height,
        meta["tile_size"], meta["isect_offsets"], meta["flatten_ids"],
    )  # fmt: skip
    dx, dy = means[0, ids, 0] - (pixels % width + 0.5), means[0, ids, 1] - (pixels // width + 0.5)
    a, b, c = conics[0, ids].unbind(-1)
    alphas = opacities[0, ids] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alphas = alphas.clamp_max(ALPHA_MAX).double()
    counts = torch.bincount(pixels, minlength=width * height)
    before = _transmittance(alphas, counts)
    weights = (alphas * before).float()
    return Contributors(counts.unflatten(0, (height, width)), ids, weights), before.float()


def _transmittance(alphas: Float[Tensor, " m"], counts: Int[Tensor, " p"]) -> Float[Tensor, " m"]:
    """Return the product of 1 - alpha over what is in front in the same pixel."""
    # One running sum over the image; float64 keeps its digits from pixel to pixel.
    passed = torch.cat([alphas.new_zeros(1), torch.log1p(-alphas).cumsum(0)])
    starts = counts.cumsum(0) - counts
    return torch.exp(passed[:-1] - passed[starts].repeat_interleave(counts))


@torch.no_grad()
def _median_depth(
    contributors: Contributors, before: Float[Tensor, " m"], depths: Float[Tensor, " n"]
) -> Float[Tensor, "h w"]:
    """Return the depth of each pixel's last Gaussian that over half of the light reaches, 0 without any."""
    counts = contributors.counts.flatten()
    pixels = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    place = torch.where(before > 0.5, torch.arange(1, len(before) + 1, device=counts.device), 0)
    last = torch.zeros_like(counts).scatter_reduce(0, pixels, place.to(counts.dtype), "amax")
    values = torch.cat([depths.new_zeros(1), depths[contributors.ids]])
    return values[last].view(contributors.counts.shape)
