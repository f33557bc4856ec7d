"""EXR image sequences: ready for a compositor."""

from collections.abc import Mapping
from pathlib import Path

from dsar.errors import ExportError
from dsar.types import Camera, Picture, RenderOutput
from dsar_exporters.color import LINEAR_REC709, ColorTarget, ocio_config
from dsar_exporters.exr.parts import write_parts
from dsar_exporters.exr.sequence import Compression, ExrSequence, Views, exr_path

__all__ = ["ColorTarget", "Compression", "ExrSequence", "Views", "exr_path", "ocio_config", "write_exr"]


def write_exr(
    output: RenderOutput,
    path: Path,
    *,
    camera: Camera,
    frame: int,
    fps: float,
    provenance: Mapping[str, str],
    colorspace: str = LINEAR_REC709,
) -> Path:
    """Write one image and return its path.

    Channels: R, G, B, A half, scene-linear, premultiplied; Z float, camera-space depth in metres, 0 where
    nothing was hit. The header carries the camera (`worldToCamera`, `worldToNDC`), the rate, the frame, the
    view, the colour space and `dsar/...` provenance. ZIPS compression. `ExrSequence` writes more.

    Args:
        output: Rendered without a background; one blended in could not be taken out of the colours.
        path: See `exr_path`.
        camera: The camera that saw the image; its name becomes the view.
        frame: Frame number.
        fps: Frames per second; NTSC rates such as 23.976 are written as their exact fractions.
        provenance: Where the image comes from.
        colorspace: `lin_rec709_scene`, or any name, alias or role of OCIO's built-in configuration.

    Raises:
        ExportError: The image is not the camera's size, or a name, rate or colour space is not usable.
        MissingDependencyError: OpenEXR (or, for other colour spaces, OpenImageIO) is not installed.
    """
    if not fps > 0:
        raise ExportError(f"{path.name}: expected frames per second > 0, found {fps}")
    sequence = ExrSequence(path.parent, target=ColorTarget(colorspace))
    sequence.check([camera])
    picture = Picture(frame, camera, output, fps=fps, provenance=provenance)
    write_parts(path, sequence.parts(picture))
    return path
