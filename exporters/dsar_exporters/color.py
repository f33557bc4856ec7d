"""From the display-referred sRGB in which avatars are trained and blended to scene-linear light.

The conversion happens once, after blending, on colours freed of their alpha; converting the blended,
premultiplied value instead would darken every soft edge.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float32

from dsar.errors import ExportError
from dsar_exporters.optional import require

LINEAR_REC709 = "lin_rec709_scene"
_CONFIG = "ocio://default"
# Below this coverage a colour has no digits left; its contribution to the image is invisible.
_MIN_ALPHA = 1e-6


def linear_from_srgb(color: Float32[np.ndarray, "*b"]) -> Float32[np.ndarray, "*b"]:
    """Decode sRGB (IEC 61966-2-1) to linear light; values above 1 follow the same curve, below 0 become 0."""
    color = np.maximum(color, np.float32(0))
    curve = ((color + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(color <= 0.04045, color / np.float32(12.92), curve)


def linear_premultiplied(
    color: Float32[np.ndarray, "h w 3"], alpha: Float32[np.ndarray, "h w"], colorspace: str
) -> Float32[np.ndarray, "h w 3"]:
    """Return display-referred sRGB, premultiplied, as premultiplied values of another colour space.

    Args:
        color: Blended sRGB, premultiplied by alpha, without a background.
        alpha: Coverage in [0, 1].
        colorspace: `lin_rec709_scene`, or any name, alias or role of the built-in OCIO configuration.

    Raises:
        ExportError: OCIO does not know the colour space.
        MissingDependencyError: A space other than lin_rec709_scene, and OpenImageIO is not installed.
    """
    coverage = alpha[..., None]
    straight = np.divide(color, coverage, out=np.zeros_like(color), where=coverage > _MIN_ALPHA)
    linear = linear_from_srgb(straight)
    if colorspace != LINEAR_REC709:
        linear = _convert_linear(linear, colorspace)
    return linear * coverage


@lru_cache
def interop_id(colorspace: str) -> str:
    """Return the Color Interop Forum's id of a colour space, `unknown` where it has none.

    Raises:
        ExportError: OCIO does not know the colour space.
        MissingDependencyError: A space other than lin_rec709_scene, and OpenImageIO is not installed.
    """
    if colorspace == LINEAR_REC709:
        return colorspace
    config = _require_oiio().ColorConfig(_CONFIG)
    name = config.resolve(colorspace)
    if name not in config.getColorSpaceNames():
        raise ExportError(
            f"colour space: expected a name or alias known to OCIO ({_CONFIG}), such as {LINEAR_REC709} or "
            f"ACEScg, found {colorspace!r}"
        )
    return config.get_color_interop_id(name) or "unknown"


def _convert_linear(linear: Float32[np.ndarray, "h w 3"], colorspace: str) -> Float32[np.ndarray, "h w 3"]:
    """Return linear Rec.709 pixels in another colour space of the built-in OCIO configuration."""
    interop_id(colorspace)  # names the colour space in its error, which the conversion's own would not
    oiio = _require_oiio()
    image = oiio.ImageBuf(np.ascontiguousarray(linear))
    converted = oiio.ImageBufAlgo.colorconvert(
        image, LINEAR_REC709, colorspace, unpremult=False, colorconfig=_CONFIG
    )
    if converted.has_error:
        raise ExportError(f"colour space {colorspace!r}: {converted.geterror()}")
    return converted.get_pixels(oiio.FLOAT)


def _require_oiio():
    return require("OpenImageIO", feature="this colour space", package="OpenImageIO", extra="exr")
