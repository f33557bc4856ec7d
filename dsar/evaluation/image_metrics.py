"""Image metrics, each on display-referred sRGB in [0, 1]."""

import importlib.util
from collections.abc import Callable, Mapping
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.metrics.lpips import Net, find_lpips_weights, load_lpips

ImageMetric = Callable[[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]], float]
"""From an image and its truth."""


_LPIPS: Mapping[str, Net] = {"lpips": "alex", "lpips_vgg": "vgg"}


def correlation(a: Float[Tensor, " n"], b: Float[Tensor, " n"]) -> float:
    """Return Pearson's correlation; 0 where one of the two does not vary."""
    a, b = a.double() - a.double().mean(), b.double() - b.double().mean()
    norm = a.norm() * b.norm()
    return float(a @ b / norm) if norm > 1e-12 else 0.0


def flip(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Return the mean LDR-FLIP of an image (Andersson et al. 2020) at the default 67 pixels per degree.

    Needs the package flip-evaluator.
    """
    import flip_evaluator

    reference, test = (x.clamp(0, 1).contiguous().cpu().numpy() for x in (truth, image))
    return float(flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False)[1])


@torch.no_grad()
def _lpips(model: torch.nn.Module, image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    pair = (x.clamp(0, 1).movedim(-1, 0)[None].float() for x in (image, truth))
    return float(model(*pair))


def load_perceptual(device: torch.device) -> tuple[dict[str, ImageMetric], dict[str, str]]:
    """Return the perceptual metrics that this installation can compute, and why it cannot compute others.

    They are of images on the device.
    """
    metrics: dict[str, ImageMetric] = {}
    skipped = {}
    for name, net in _LPIPS.items():
        if find_lpips_weights(net).exists():
            metrics[name] = partial(_lpips, load_lpips(net).to(device))
        else:
            skipped[name] = "its weights are not on this machine: run tools/fetch_lpips.py"
    if importlib.util.find_spec("flip_evaluator"):
        metrics["flip"] = flip
    else:
        skipped["flip"] = 'package flip-evaluator is missing: pip install "dsar-avatar[eval]"'
    return metrics, skipped
