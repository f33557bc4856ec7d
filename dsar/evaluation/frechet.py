"""Fréchet distances between films: FVD with a user's own I3D network, and a stand-in that needs none.

FVD (Unterthiner et al. 2018) needs I3D's weights, which no package distributes: a TorchScript file as
StyleGAN-V and others use it, named by $DSAR_I3D. The stand-in, `frechet_slices`, compares pictures whose one
axis is time (x-t and y-t slices) by features of LPIPS's AlexNet: flicker and frozen motion show as texture.
It is no FVD and cannot be compared with one. Both are biased where films are few: only equal sets compare.
"""

import os
import warnings
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from dsar.errors import ConfigError
from dsar.metrics.lpips import Lpips

CLIP, STRIDE = 16, 8
"""Frames of a clip, and from one clip's start to the next one's."""
_SLICES = 4
"""Slices of a clip along each axis, evenly spaced."""
_I3D_SIDE = 224
_SLICE_SIZE = (64, 224)
"""Pixels of a slice in time and in space, as the network sees it."""

Video = UInt8[np.ndarray, "f h w 3"]


def slice_features(video: Video, network: Lpips) -> Float[Tensor, "c 512"]:
    """Return a vector for each clip of a film: AlexNet's last features, means over x-t and y-t slices."""
    return torch.stack([_slices_of(clip, network) for clip in _clips(video)])


@torch.no_grad()
def _slices_of(clip: Float[Tensor, "t h w 3"], network: Lpips) -> Float[Tensor, " d"]:
    found = []
    for axis in (1, 2):
        places = torch.linspace(0, clip.shape[axis] - 1, _SLICES + 2)[1:-1].round().long()
        pictures = clip.index_select(axis, places).movedim(axis, 0).movedim(-1, 1)
        pictures = nn.functional.interpolate(pictures, _SLICE_SIZE, mode="bilinear", antialias=True)
        features = (2 * pictures - 1 - network.shift) / network.scale
        for stage in network.stages:
            features = stage(features)
        found.append(features.mean((0, 2, 3)))
    return torch.cat(found)


def load_i3d() -> nn.Module | None:
    """Return the user's I3D network, if $DSAR_I3D names one.

    Raises:
        ConfigError: what it names is not there, or is no network.
    """
    named = os.environ.get("DSAR_I3D")
    if not named:
        return None
    if not Path(named).is_file():
        raise ConfigError(f"$DSAR_I3D names {named}, which is no file; expected I3D as TorchScript")
    try:
        with warnings.catch_warnings():
            # What the field shares is TorchScript, whatever torch would rather have.
            warnings.simplefilter("ignore", DeprecationWarning)
            return torch.jit.load(named)
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"$DSAR_I3D names {named}; expected I3D as TorchScript, found {reason}") from error


@torch.no_grad()
def i3d_features(video: Video, network: nn.Module) -> Float[Tensor, "c d"]:
    """Return I3D's features of each clip of a film, seen at 224x224."""
    found = []
    for clip in _clips(video):
        size = (_I3D_SIDE, _I3D_SIDE)
        frames = nn.functional.interpolate(clip.movedim(-1, 1), size, mode="bilinear", antialias=True)
        seen = (2 * frames - 1).movedim(1, 0)[None]
        found.append(network(seen, rescale=False, resize=False, return_features=True)[0])
    return torch.stack(found)


def _clips(video: Video) -> list[Float[Tensor, "t h w 3"]]:
    starts = range(0, len(video) - CLIP + 1, STRIDE)
    return [torch.from_numpy(video[start : start + CLIP]).float() / 255 for start in starts]


def frechet_distance(made: Float[Tensor, "a d"], true: Float[Tensor, "b d"]) -> float:
    """Return |m - n|² + tr(C + D - 2 (C D)^½) of the means m, n and covariances C, D of two sets of vectors.

    Each set needs two vectors or more.
    """
    means, covariances = zip(
        *((x.mean(0), torch.cov(x.T)) for x in (made.double(), true.double())), strict=True
    )
    # C D has the eigenvalues of C^½ D C^½, which are real and not negative.
    roots = torch.linalg.eigvals(covariances[0] @ covariances[1]).real.clamp_min(0).sqrt()
    spread = covariances[0].trace() + covariances[1].trace() - 2 * roots.sum()
    return float((means[0] - means[1]).square().sum() + spread)
