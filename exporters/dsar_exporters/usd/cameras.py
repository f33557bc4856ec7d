"""Cameras whose frustums project exactly as our pinholes do, off-centre principal points included.

Imports pxr: only the writers of an asset import this module.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from dsar.geometry.cameras import world_from_camera
from dsar.types import Camera

# 50 mm: USD counts focal lengths and apertures in tenths of a scene unit. Only their ratio shapes the image.
_FOCAL_LENGTH = 0.5
_CLIPPING_RANGE_M = (0.01, 1000.0)


def define_camera(stage: Usd.Stage, path: Sdf.Path | str, camera: Camera) -> Usd.Attribute:
    """Author a camera's lens and return the attribute that places it; `world_matrix` makes its values."""
    prim = UsdGeom.Camera.Define(stage, path)
    K = camera.K.double().numpy()
    horizontal = camera.width * _FOCAL_LENGTH / K[0, 0]
    vertical = camera.height * _FOCAL_LENGTH / K[1, 1]
    prim.CreateFocalLengthAttr(_FOCAL_LENGTH)
    prim.CreateHorizontalApertureAttr(horizontal)
    prim.CreateVerticalApertureAttr(vertical)
    prim.CreateHorizontalApertureOffsetAttr(horizontal * (0.5 - K[0, 2] / camera.width))
    prim.CreateVerticalApertureOffsetAttr(vertical * (K[1, 2] / camera.height - 0.5))
    prim.CreateClippingRangeAttr(Gf.Vec2f(*_CLIPPING_RANGE_M))
    # The schema has no resolution; square pixels follow from it.
    prim.GetPrim().SetCustomDataByKey("dsar:resolution", Gf.Vec2i(camera.width, camera.height))
    return prim.AddTransformOp().GetAttr()


def world_matrix(camera: Camera) -> Gf.Matrix4d:
    """Return where a camera stands, as USD's row-vector matrix."""
    matrix = np.ascontiguousarray(world_from_camera(camera, "opengl").T)
    return Gf.Matrix4d(matrix.tolist())
