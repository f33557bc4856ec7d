"""From a picture to an EXR's channels."""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dsar.errors import ExportError
from dsar.types import Picture
from dsar_exporters.color import ColorTarget
from dsar_exporters.exr.cryptomatte import matte_channels

_HALF_MAX = 65504.0
NO_GAUSSIAN = np.uint32(0xFFFFFFFF)
"""`id` where no Gaussian was hit; 0 is the first one's."""
Channels = dict[str, np.ndarray]
"""By name; arrays of three axes are groups such as `RGBA`."""


def color_channels(picture: Picture, layers: Collection[str], target: ColorTarget) -> Channels:
    """Return R, G, B and A (half, premultiplied), or A alone, or nothing, as `layers` asks."""
    if "rgba" not in layers and "alpha" not in layers:
        return {}
    color, alpha = _array(picture.output.color), _array(picture.output.alpha)
    if "rgba" not in layers:
        return {"A": alpha.astype(np.float16)}
    pixels = np.concatenate([target.premultiplied(color, alpha), alpha[..., None]], -1)
    return {"RGBA": pixels.clip(-_HALF_MAX, _HALF_MAX).astype(np.float16)}


def data_channels(picture: Picture, layers: Collection[str]) -> Channels:
    """Return the channels that are no colour: float, and `id` unsigned integer."""
    aovs = picture.aovs
    channels: Channels = {}
    if "Z" in layers:
        channels["Z"] = _array(picture.output.depth)
        if picture.output.first_hit_depth is not None:
            channels["front.Z"] = _array(picture.output.first_hit_depth)
    if "N" in layers:
        channels |= _split("N", "XYZ", _required("N", aovs.normals))
    if "P" in layers:
        channels |= _split("P", "XYZ", _required("P", aovs.positions))
    if "motion" in layers:
        # Compositors count pixels upwards.
        upwards = torch.tensor([1.0, -1.0])
        channels |= _split("forward", "uv", _required("motion", aovs.forward) * upwards)
        channels |= _split("backward", "uv", _required("motion", aovs.backward) * upwards)
    if "id" in layers:
        ids = _required("id", picture.output.largest_weight_id).numpy()
        channels["id"] = np.where(ids < 0, NO_GAUSSIAN, ids.astype(np.uint32))
    if "crypto" in layers:
        _require("crypto", bool(aovs.coverage))
        channels |= matte_channels(aovs.coverage)
    return channels


def crop(channels: Mapping[str, Any], rows: slice, columns: slice) -> dict[str, Any]:
    """Return the channels' pixels of a rectangle."""
    return {name: np.ascontiguousarray(values[rows, columns]) for name, values in channels.items()}


def _split(layer: str, names: str, values: Tensor) -> Channels:
    """Return a layer's channels, one by one."""
    return {f"{layer}.{name}": _array(values[..., index]) for index, name in enumerate(names)}


def _required(layer: str, values: Tensor | None) -> Tensor:
    """Return an output variable that the picture must have."""
    _require(layer, values is not None)
    assert values is not None
    return values


def _require(layer: str, present: bool) -> None:
    if not present:
        raise ExportError(
            f"EXR: expected a picture with {layer}, found one without: render it with --aov {layer}"
        )


def _array(values: Tensor) -> np.ndarray:
    return values.detach().cpu().float().contiguous().numpy()
