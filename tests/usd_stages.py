"""Cameras on USD stages as other applications write them, and how they are read and projected."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from pxr import Gf, Usd, UsdGeom

from dsar.geometry.camera_paths import CameraPath
from dsar.geometry.cameras import project
from dsar.types import Camera
from dsar_exporters import read_usd_cameras

FRAMES = range(1001, 1007)


SIZE = (1920, 1080)


POINTS = torch.rand(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5


Stages = Callable[..., Usd.Stage]


def add_camera(stage: Usd.Stage, path: str, *, shift: float = 0.0) -> UsdGeom.Camera:
    """A 16:9 lens, five metres off in centimetres, looking at the origin along its -Z."""
    camera = UsdGeom.Camera.Define(stage, path)
    camera.CreateFocalLengthAttr(35.0)
    camera.CreateHorizontalApertureAttr(24.0)
    camera.CreateVerticalApertureAttr(13.5)
    camera.CreateHorizontalApertureOffsetAttr(shift)
    camera.CreateVerticalApertureOffsetAttr(-0.5 * shift)
    UsdGeom.Xformable(camera).AddTranslateOp().Set(Gf.Vec3d(10, 20, 500))
    return camera


def read(stage: Usd.Stage, frames=FRAMES, resolution=SIZE, fps=24.0) -> list[CameraPath]:
    stage.Save()
    path = Path(stage.GetRootLayer().realPath)
    return read_usd_cameras(path, frames=frames, resolution=resolution, fps=fps)


def usd_pixels(stage: Usd.Stage, path: str, time: float, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Project as USD does; of our metres and Y up it makes the stage's."""
    frustum = UsdGeom.Camera.Get(stage, path).GetCamera(time).frustum
    matrix = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
    points = POINTS.numpy() / UsdGeom.GetStageMetersPerUnit(stage)
    if UsdGeom.GetStageUpAxis(stage) == "Z":
        points = points @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    clip = np.concatenate([points, np.ones((len(points), 1))], 1) @ matrix
    return (clip[:, :2] / clip[:, 3:] * [1, -1] + 1) / 2 * np.array(size)


def pixels(camera: Camera) -> np.ndarray:
    found, depth = project(camera, POINTS)
    assert (depth > 0).all()
    return found.numpy()
