"""What our files say of cameras, as the formats' own libraries read it."""

import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from dsar.types import Camera, Gaussians, GaussianSequence, Picture, RenderOutput
from dsar_exporters.exr import ExrSequence
from dsar_exporters.exr.camera_attributes import read_projections
from dsar_exporters.usd import read_usd_projections, write_usd

Projections = dict[str, Float[np.ndarray, "4 4"]]
"""By camera: world metres (homogeneous, column vectors) to pixels times w, in rows 0, 1 and 3."""

_FRAME, _FPS = 1001, 24.0


def read_back_projections(cameras: Sequence[Camera]) -> dict[str, Projections]:
    """Write cameras to a USD asset and to EXR images, and return how those project, by format.

    `usd`: the stage's frustums. `exr`: worldToNDC. `exr_lens`: worldToCamera and the lens.

    Raises:
        ExportError: A camera cannot be written.
        MissingDependencyError: A format's library is not installed.
    """
    # Any name will do here, also one that a file of ours could not have.
    plain = [dataclasses.replace(camera, name=f"cam_{index}") for index, camera in enumerate(cameras)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stage = write_usd(_single_gaussian(), folder / "cameras.usda", name="crosscheck", cameras=plain)
        sizes = {camera.name: (camera.width, camera.height) for camera in plain}
        projections = {"usd": read_usd_projections(stage, sizes)}
        for camera in plain:
            for kind, matrix in read_projections(_write_empty(camera, folder)).items():
                projections.setdefault(kind, {})[camera.name] = matrix
    names = {new.name: old.name for new, old in zip(plain, cameras, strict=True)}
    return {
        kind: {names[key]: matrix for key, matrix in matrices.items()}
        for kind, matrices in projections.items()
    }


def _single_gaussian() -> GaussianSequence:
    """Return one Gaussian, for an asset has to hold something."""
    gaussian = Gaussians(
        means=torch.zeros(1, 3),
        rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), 0.01),
        opacities=torch.ones(1),
        harmonics=torch.zeros(1, 1, 3),
    )
    return GaussianSequence((_FRAME,), _FPS, 1, lambda: iter([gaussian]))


def _write_empty(camera: Camera, folder: Path) -> Path:
    """Write an image that holds one pixel, however large the camera's is."""
    size = camera.height, camera.width
    empty = RenderOutput(torch.zeros(*size, 3), torch.zeros(size), torch.zeros(size), torch.tensor(0))
    files = ExrSequence(folder, layers=("alpha",), crop=True)
    (path,) = files.write([Picture(_FRAME, camera, empty, fps=_FPS)], [""])
    return path
