"""Eight-bit images for people to look at; a compositor gets EXR instead."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from dsar.types import RenderOutput
from dsar_render.drafts import replacing

# Below this coverage an 8-bit alpha is zero and a straight colour is noise.
_MIN_ALPHA = 0.5 / 255


def display_image(output: RenderOutput) -> UInt8[np.ndarray, "h w 3"]:
    """Return sRGB over the background that was rendered, or over black if none was."""
    return _quantized(output.color.detach().cpu().numpy())


def write_png(output: RenderOutput, path: Path) -> Path:
    """Write an 8-bit sRGB PNG with straight (not premultiplied) alpha and return its path.

    Args:
        output: Rendered without a background.
        path: The file, which appears when it is complete; folders are made if missing.
    """
    color, alpha = output.color.detach().cpu().numpy(), output.alpha.detach().cpu().numpy()
    coverage = alpha[..., None]
    straight = np.divide(color, coverage, out=np.zeros_like(color), where=coverage >= _MIN_ALPHA)
    with replacing(path) as draft:
        Image.fromarray(_quantized(np.concatenate([straight, coverage], -1))).save(draft, format="PNG")
    return path


def _quantized(values: Float[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    """Return values of 0..1 as 0..255, rounded to nearest."""
    return (values.clip(0, 1) * 255 + 0.5).astype(np.uint8)
