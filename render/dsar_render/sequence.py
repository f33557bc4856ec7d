"""A rollout seen by cameras."""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.raster import rasterize
from dsar.types import Camera, GaussianSequence, RenderOutput
from dsar_render.camera_names import check_camera_names


def render_sequence(
    sequence: GaussianSequence,
    cameras: Sequence[Camera],
    *,
    background: Float[Tensor, "3"] | None = None,
) -> Iterator[tuple[int, Camera, RenderOutput]]:
    """Yield (frame number, camera, image) for every frame, cameras innermost.

    Each frame is produced once, whatever the number of cameras: the network is the costly part. No gradients.

    Args:
        sequence: The frames, produced once and one at a time.
        cameras: Views of each frame, in the order they are rendered.
        background: Display-referred sRGB behind the person; None leaves it transparent, as an EXR needs.

    Raises:
        ConfigError: There are no cameras, or two share a name and would overwrite each other's files.
    """
    check_camera_names([camera.name for camera in cameras])
    return _render_frames(sequence, cameras, background)


def _render_frames(
    sequence: GaussianSequence, cameras: Sequence[Camera], background: Float[Tensor, "3"] | None
) -> Iterator[tuple[int, Camera, RenderOutput]]:
    for frame, gaussians in sequence:
        detached = gaussians.detach()
        for camera in cameras:
            # Entered per image: a generator that yields inside would switch its caller's gradients off.
            with torch.no_grad():
                output = rasterize(detached, camera, background=background)
            yield frame, camera, output
