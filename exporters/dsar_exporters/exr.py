"""EXR image sequences: one camera and one frame a file, ready for a compositor."""

from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from dsar.errors import ExportError
from dsar.types import Camera, RenderOutput
from dsar_exporters.checks import check_name
from dsar_exporters.color import LINEAR_REC709, interop_id, linear_premultiplied
from dsar_exporters.drafts import replacing
from dsar_exporters.optional import require

_HALF_MAX = 65504.0
_NTSC = Fraction(1000, 1001)


def exr_path(folder: Path, *, name: str, camera: str, frame: int) -> Path:
    """Return the path of an image in a sequence: `folder/<camera>/<name>.<camera>.<frame, 4 digits>.exr`."""
    return folder / camera / f"{name}.{camera}.{frame:04d}.exr"


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
    view, the colour space and `dsar/...` provenance. ZIP compression.

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
    height, width = output.alpha.shape
    if (width, height) != (camera.width, camera.height):
        raise ExportError(
            f"{path.name}: expected an image of {camera.width}x{camera.height} from camera {camera.name}, "
            f"found {width}x{height}: render with the camera that is passed"
        )
    check_name("camera name", camera.name)
    if not fps > 0:
        raise ExportError(f"{path.name}: expected frames per second > 0, found {fps}")
    openexr = require("OpenEXR", feature="EXR", package="OpenEXR", extra="exr")
    header = {
        "compression": openexr.ZIP_COMPRESSION,
        "type": openexr.scanlineimage,
        "worldToCamera": _world_to_camera(camera),
        "worldToNDC": _world_to_ndc(camera),
        "framesPerSecond": rational_fps(fps),
        "imageCounter": frame,
        "cameraLabel": camera.name,
        # A file of one view carries both, so that readers of either convention find it.
        "view": camera.name,
        "multiView": [camera.name],
        "colorInteropID": interop_id(colorspace),
        **{f"dsar/{key}": value for key, value in provenance.items()},
    }
    color, alpha, depth = (
        values.detach().cpu().float().contiguous().numpy()
        for values in (output.color, output.alpha, output.depth)
    )
    linear = linear_premultiplied(color, alpha, colorspace)
    pixels = np.concatenate([linear, alpha[..., None]], -1).clip(-_HALF_MAX, _HALF_MAX).astype(np.float16)
    with replacing(path) as draft:
        openexr.File(header, {"RGBA": pixels, "Z": depth}).write(str(draft))
    return path


def rational_fps(fps: float) -> Fraction:
    """Return a frame rate as the fraction it stands for: 24/1, 25/2, and 24000/1001 for 23.976."""
    whole = round(fps)
    ntsc = whole * _NTSC
    if fps != whole and abs(fps - ntsc) < 1e-3:
        return ntsc
    return Fraction(fps).limit_denominator(1000)


def _world_to_camera(camera: Camera) -> Float32[np.ndarray, "4 4"]:
    """Return OpenEXR's worldToCamera: row vectors, left-handed (x right, y up, z forward), metres."""
    transform = camera.T_camera_world.double().numpy()
    return _row_vector_form(np.diag([1.0, -1.0, 1.0, 1.0]) @ transform)


def _world_to_ndc(camera: Camera) -> Float32[np.ndarray, "4 4"]:
    """Return OpenEXR's worldToNDC: row vectors, after division by w (0, 0) top left, (1, 1) bottom right."""
    K = camera.K.double().numpy() / np.array([[camera.width], [camera.height], [1.0]])
    projection = np.zeros((4, 4))
    projection[:2, :3], projection[2, 2], projection[3, 2] = K[:2], 1.0, 1.0
    return _row_vector_form(projection @ camera.T_camera_world.double().numpy())


def _row_vector_form(matrix: Float[np.ndarray, "4 4"]) -> Float32[np.ndarray, "4 4"]:
    """Return the transpose in memory too: OpenEXR copies an array's buffer and ignores its strides."""
    return np.ascontiguousarray(matrix.T, dtype=np.float32)
