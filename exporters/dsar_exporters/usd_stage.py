"""The asset around the Gaussians: metadata, variants, payload and cameras.

Imports pxr: only `write_usd` imports this module.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Usd, UsdGeom, Vt

from dsar.geometry.cameras import world_from_camera
from dsar.types import Camera, GaussianSequence
from dsar_exporters.usd_particles import author_particles

INSTANCER, SPLATS = "instancer", "splats"
# 50 mm: USD counts focal lengths and apertures in tenths of a scene unit. Only their ratio shapes the image.
_FOCAL_LENGTH = 0.5
_CLIPPING_RANGE_M = (0.01, 1000.0)


def author_asset(
    sequence: GaussianSequence, path: Path, *, name: str, cameras: Sequence[Camera]
) -> list[Path]:
    """Write the files of an asset and return their paths, the root layer last.

    Args:
        sequence: The frames, ascending.
        path: The root layer; a `.usda` gets a payload `<stem>.payload.usdc` beside it.
        name: Name of the root prim.
        cameras: The rig.
    """
    stage = Usd.Stage.CreateNew(str(path))
    _describe_stage(stage, sequence, name)
    root = stage.GetDefaultPrim()
    if path.suffix == ".usda":
        payload_path = path.with_suffix(".payload.usdc")
        payload = Usd.Stage.CreateNew(str(payload_path))
        _describe_stage(payload, sequence, name)
        bounds = author_particles(payload, sequence)
        payload.Save()
        root.GetPayloads().AddPayload(f"./{payload_path.name}")
        paths = [payload_path, path]
    else:
        bounds = author_particles(stage, sequence)
        paths = [path]
    # Lets applications frame the asset before they load its payload.
    UsdGeom.ModelAPI.Apply(root).SetExtentsHint(Vt.Vec3fArray.FromNumpy(bounds))
    _author_variants(stage)
    for camera in cameras:
        _author_camera(stage, camera)
    stage.Save()
    return paths


def _describe_stage(stage: Usd.Stage, sequence: GaussianSequence, name: str) -> None:
    """Author units, axes, time, provenance and the default prim."""
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetTimeCodesPerSecond(sequence.fps)
    stage.SetFramesPerSecond(sequence.fps)
    stage.SetStartTimeCode(sequence.frame_numbers[0])
    stage.SetEndTimeCode(sequence.frame_numbers[-1])
    stage.GetRootLayer().customLayerData = {"dsar": dict(sequence.provenance)}
    root = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(root)
    model = Usd.ModelAPI(root)
    model.SetKind(Kind.Tokens.component)
    model.SetAssetName(name)


def _author_variants(stage: Usd.Stage) -> None:
    """Author the variant set that shows one representation and hides the other."""
    root = stage.GetDefaultPrim()
    variants = root.GetVariantSets().AddVariantSet("representation")
    for shown, hidden in ((INSTANCER, SPLATS), (SPLATS, INSTANCER)):
        variants.AddVariant(shown)
        variants.SetVariantSelection(shown)
        with variants.GetVariantEditContext():
            prim = stage.OverridePrim(root.GetPath().AppendChild(hidden))
            UsdGeom.Imageable(prim).CreateVisibilityAttr(UsdGeom.Tokens.invisible)
    variants.SetVariantSelection(INSTANCER)


def _author_camera(stage: Usd.Stage, camera: Camera) -> None:
    """Author a static camera whose frustum projects like the pinhole."""
    scope = UsdGeom.Scope.Define(stage, stage.GetDefaultPrim().GetPath().AppendChild("cameras"))
    prim = UsdGeom.Camera.Define(stage, scope.GetPath().AppendChild(camera.name))
    K = camera.K.double().numpy()
    horizontal = camera.width * _FOCAL_LENGTH / K[0, 0]
    vertical = camera.height * _FOCAL_LENGTH / K[1, 1]
    prim.CreateFocalLengthAttr(_FOCAL_LENGTH)
    prim.CreateHorizontalApertureAttr(horizontal)
    prim.CreateVerticalApertureAttr(vertical)
    prim.CreateHorizontalApertureOffsetAttr(horizontal * (0.5 - K[0, 2] / camera.width))
    prim.CreateVerticalApertureOffsetAttr(vertical * (K[1, 2] / camera.height - 0.5))
    prim.CreateClippingRangeAttr(Gf.Vec2f(*_CLIPPING_RANGE_M))
    # USD's row vectors take the transpose.
    matrix = np.ascontiguousarray(world_from_camera(camera, "opengl").T)
    prim.AddTransformOp().Set(Gf.Matrix4d(matrix.tolist()))
    # The schema has no resolution; square pixels follow from it.
    prim.GetPrim().SetCustomDataByKey("dsar:resolution", Gf.Vec2i(camera.width, camera.height))
