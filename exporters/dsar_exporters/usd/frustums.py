"""Cameras of a stage as USD itself computes their projection.

Imports pxr: only `dsar_exporters.usd` imports this module, when it reads.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from pxr import Usd, UsdGeom

from dsar.errors import ExportError


def project_with_frustums(
    path: Path, sizes: Mapping[str, tuple[int, int]]
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Return projections; see `dsar_exporters.usd.read_usd_projections`."""
    stage = Usd.Stage.Open(str(path))
    prims = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    cameras = {prim.GetName(): UsdGeom.Camera(prim) for prim in prims if prim.GetName() in sizes}
    if missing := sorted(set(sizes) - set(cameras)):
        raise ExportError(
            f"{path}: expected cameras {', '.join(missing)}, found {', '.join(cameras) or 'none'}"
        )
    time = Usd.TimeCode(stage.GetStartTimeCode())
    stage_from_world = _stage_from_world(stage)
    return {name: _projection(cameras[name], time, *size) @ stage_from_world for name, size in sizes.items()}


def _stage_from_world(stage: Usd.Stage) -> np.ndarray:
    """Return the matrix from metres, Y up, to what a stage says that it is in (column vectors)."""
    rotation = np.eye(4)
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        rotation[1:3, 1:3] = [[0.0, -1.0], [1.0, 0.0]]
    scale = 1 / UsdGeom.GetStageMetersPerUnit(stage)
    return np.diag([scale, scale, scale, 1.0]) @ rotation


def _projection(camera: UsdGeom.Camera, time: Usd.TimeCode, width: int, height: int) -> np.ndarray:
    frustum = camera.GetCamera(time).frustum
    # Row vectors to column vectors; x and y from -1..1, y up, to pixels.
    clip = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix(), np.float64).T
    x = np.array([width / 2, 0.0, 0.0, width / 2])
    y = np.array([0.0, -height / 2, 0.0, height / 2])
    pixels = np.eye(4)
    pixels[0], pixels[1] = x, y
    return pixels @ clip
