"""Cryptomatte: mattes of named parts, with soft edges (Friedman and Jones 2015, specification 1.2)."""

import json
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32
from torch import Tensor

from dsar_exporters.optional import require

LAYER = "CryptoMaterial"
"""Parts of one avatar are told apart as materials of one object are."""
_RANKS = 6
"""Parts that a pixel can name; two a layer of four channels."""


def matte_metadata(names: list[str]) -> dict[str, str]:
    """Return the header attributes by which readers find the layer and its names."""
    key = f"cryptomatte/{_hex(LAYER)[:7]}"
    manifest = {name: _hex(name) for name in names}
    return {
        f"{key}/name": LAYER,
        f"{key}/hash": "MurmurHash3_32",
        f"{key}/conversion": "uint32_to_float32",
        f"{key}/manifest": json.dumps(manifest, separators=(",", ":")),
    }


def matte_channels(coverage: Mapping[str, Tensor]) -> dict[str, Float32[np.ndarray, "h w 4"]]:
    """Return the layers `CryptoMaterial00`, `01`, `02`: id, coverage, id, coverage, the largest first.

    Coverages of a pixel sum to its alpha; where more than six parts share one, the six largest do.
    """
    names = list(coverage)
    images = [coverage[name].numpy() for name in names]
    # Most of a picture is empty.
    hit = np.sum(images, axis=0) > 0
    stack = np.stack([image[hit] for image in images], -1)
    ids = np.array([float_id(name) for name in names], np.float32)
    # Stable, so that equal shares have one order everywhere.
    order = np.argsort(-stack, axis=-1, kind="stable")[..., :_RANKS]
    ranked = np.take_along_axis(stack, order, -1)
    ranked_total, total = ranked.sum(-1, keepdims=True), stack.sum(-1, keepdims=True)
    ranked = ranked * (total / ranked_total)
    named = np.where(ranked > 0, ids[order], np.float32(0))
    image = np.zeros((*hit.shape, _RANKS, 2), np.float32)
    image[hit, : ranked.shape[-1]] = np.stack([named, ranked], -1)
    layers = image.reshape(*hit.shape, _RANKS // 2, 4)
    return {f"{LAYER}{index:02d}": np.ascontiguousarray(layers[:, :, index]) for index in range(_RANKS // 2)}


def float_id(name: str) -> np.float32:
    """Return the number that stands for a name in id channels: its hash's bits, never a NaN or denormal."""
    return np.array([_hash(name)], np.uint32).view(np.float32)[0]


def _hash(name: str) -> int:
    """Return MurmurHash3_32 of a name, the exponent's lowest bit flipped where all of its bits are equal."""
    mmh3 = require("mmh3", feature="Cryptomatte", package="mmh3", extra="exr")
    bits = mmh3.hash(name, 0, signed=False)
    return bits ^ 1 << 23 if bits >> 23 & 255 in (0, 255) else bits


def _hex(name: str) -> str:
    return f"{_hash(name):08x}"
