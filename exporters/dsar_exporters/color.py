"""From the display-referred sRGB in which avatars are trained and blended to scene-linear light.

The conversion happens once, after blending, on colours freed of their alpha; converting the blended,
premultiplied value instead would darken every soft edge.
"""

import os
import socket
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from dsar.color import linear_from_srgb
from dsar.errors import ExportError
from dsar_exporters.ocio_files import hash_config
from dsar_exporters.optional import require

LINEAR_REC709 = "lin_rec709_scene"
_BUILT_IN = "ocio://default"
_SOURCES = ("srgb_rec709_scene", "srgb_tx", "sRGB - Texture", "Utility - sRGB - Texture")
"""Names that configurations have for what the avatars' colours are: sRGB's curve on Rec.709's primaries,
without a display's view transform."""
# Below this coverage a colour has no digits left; its contribution to the image is invisible.
_MIN_ALPHA = 1e-6


@dataclass(frozen=True)
class ColorTarget:
    """A colour space to write, and the configuration that knows it.

    Raises:
        ExportError: The configuration cannot be read, or does not know the colour space, or not the sRGB that
            the avatar's colours are in.
        MissingDependencyError: A space other than lin_rec709_scene, and OpenImageIO is not installed.
    """

    colorspace: str = LINEAR_REC709
    """`lin_rec709_scene`, or any name, alias or role of the configuration."""
    config: str = _BUILT_IN
    """An OCIO configuration's file, or the name of a built-in one."""
    contents: str = field(init=False)
    """A hash of what the configuration says, with the look-up tables that it names, where this was made."""

    def __post_init__(self) -> None:
        """Look the colour space up, so that a wrong name is found before any work."""
        _ = self.interop_id
        object.__setattr__(self, "contents", hash_config(self.config))

    @property
    def key(self) -> str:
        """All that colours depend on, but no paths: machines mount folders where they like."""
        return repr((self.colorspace, self.contents))

    @property
    def interop_id(self) -> str:
        """The Color Interop Forum's id of the colour space, `unknown` where it has none."""
        return _interop_id(self.colorspace, self.config)

    def from_display(self, straight: Float32[np.ndarray, "*n 3"]) -> Float32[np.ndarray, "*n 3"]:
        """Return display-referred sRGB, not premultiplied, in this colour space.

        Raises:
            ExportError: This process, maybe of another machine, has another configuration in that place.
        """
        linear = linear_from_srgb(straight)
        # Without a configuration of the user's, Rec.709 needs none.
        if (self.colorspace, self.config) == (LINEAR_REC709, _BUILT_IN):
            return linear
        _check_contents(self.config, self.contents)
        return _converted(straight, self.colorspace, self.config)

    def premultiplied(
        self, color: Float32[np.ndarray, "h w 3"], alpha: Float32[np.ndarray, "h w"]
    ) -> Float32[np.ndarray, "h w 3"]:
        """Return blended, premultiplied sRGB as premultiplied values of this colour space.

        Args:
            color: Blended sRGB, premultiplied by alpha, without a background.
            alpha: Coverage in [0, 1].
        """
        result = np.zeros_like(color)
        # Most of a picture is empty.
        hit = alpha > _MIN_ALPHA
        coverage = alpha[hit, None]
        result[hit] = self.from_display(color[hit] / coverage) * coverage
        return result


def ocio_config(path: Path | str | None) -> str:
    """Return the configuration to use: the one named, else $OCIO's, else the built-in default."""
    return str(path) if path is not None else os.environ.get("OCIO") or _BUILT_IN


@lru_cache
def _check_contents(config: str, contents: str) -> None:
    """Check, once a process, that a configuration is what it was where the work was given out."""
    if not config.startswith("ocio://") and not Path(config).is_file():
        raise ExportError(
            f"--ocio {config}: no such file on {socket.gethostname()}; put the configuration where all "
            "machines see it"
        )
    if hash_config(config) != contents:
        raise ExportError(
            f"--ocio {config}: it, files or variables that it refers to are others on {socket.gethostname()} "
            "than where the render was started; put the configuration where all machines see it"
        )


@lru_cache
def _interop_id(colorspace: str, config: str) -> str:
    if (colorspace, config) == (LINEAR_REC709, _BUILT_IN):
        return colorspace
    ocio = _open(config)
    if ocio.resolve(colorspace) not in ocio.getColorSpaceNames():
        raise ExportError(
            f"colour space: expected a name, alias or role known to OCIO ({config}), such as {LINEAR_REC709} "
            f"or ACEScg, found {colorspace!r}"
        )
    _source(config)
    return ocio.get_color_interop_id(ocio.resolve(colorspace)) or "unknown"


@lru_cache
def _source(config: str) -> str:
    """Return the configuration's name for the colours of avatars."""
    ocio = _open(config)
    names = ocio.getColorSpaceNames()
    source = next((name for name in _SOURCES if ocio.resolve(name) in names), None)
    if source is None:
        raise ExportError(
            f"--ocio {config}: expected a colour space for sRGB textures, found none of "
            f"{', '.join(_SOURCES)}: make one of them an alias in the configuration"
        )
    return source


def _open(config: str):
    """Return a configuration; not kept, because OpenImageIO complains of any that is left at the end."""
    if not config.startswith("ocio://") and not Path(config).is_file():
        raise ExportError(f"--ocio {config}: expected an OCIO configuration, found no such file")
    ocio = _require_oiio().ColorConfig(config)
    if ocio.geterror() or not ocio.getColorSpaceNames():
        raise ExportError(f"--ocio {config}: expected an OCIO configuration, found one that cannot be read")
    return ocio


def _converted(
    straight: Float32[np.ndarray, "*n 3"], colorspace: str, config: str
) -> Float32[np.ndarray, "*n 3"]:
    """Return display-referred colours in another colour space of a configuration; below 0 becomes 0."""
    if not straight.size:
        return straight
    oiio = _require_oiio()
    pixels = np.ascontiguousarray(np.maximum(straight, 0).reshape(1, -1, 3))
    image = oiio.ImageBuf(pixels)
    converted = oiio.ImageBufAlgo.colorconvert(
        image, _source(config), colorspace, unpremult=False, colorconfig=config
    )
    if converted.has_error:
        raise ExportError(f"colour space {colorspace!r}: {converted.geterror()}")
    return converted.get_pixels(oiio.FLOAT).reshape(straight.shape)


def _require_oiio():
    return require("OpenImageIO", feature="this colour space", package="OpenImageIO", extra="exr")
