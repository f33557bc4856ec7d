"""The Gaussians of a rollout over time, for two USD schemas at once.

Imports pxr: only the writers of an asset import this module.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from pxr import Gf, Sdf, Usd, UsdGeom, UsdVol, Vt

from dsar.types import Binding
from dsar_exporters.color import LINEAR_REC709
from dsar_exporters.usd.influences import largest_influences
from dsar_exporters.usd.levels import Level
from dsar_exporters.usd.particle_frame import ParticleFrame
from dsar_exporters.usd.timeline import SharedValue, Timeline

INSTANCER, SPLATS = "instancer", "splats"
SIGMA_SCALE = 2.0
"""Standard deviations to the surface of an ellipsoid: it then looks about as large as the splat."""
INFLUENCES = 4
"""Joints that a Gaussian's authored skin weights name, those with the largest weights."""
COLOR_SPACE = "srgb_rec709_display"
"""The Color Interop Forum's id, as other splat writers use it; Gf has no display-referred names yet."""


class ParticleWriter:
    """A PointInstancer and a ParticleField3DGaussianSplat that receive the same frames of one level."""

    def __init__(
        self,
        stage: Usd.Stage,
        timeline: Timeline,
        level: Level,
        harmonics_count: int,
        *,
        first_frame: int,
        half: bool,
        binding: Binding | None,
    ) -> None:
        self._timeline, self._level, self._half = timeline, level, half
        root = stage.GetPrimAtPath(f"/{level.name}").GetPath()
        self._instancer = UsdGeom.PointInstancer.Define(stage, root.AppendChild(INSTANCER))
        self._splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, root.AppendChild(SPLATS))
        self._define_instancer(stage)
        self._define_splats(harmonics_count)
        splats = self._splats
        prims = (self._instancer.GetPrim(), splats.GetPrim())
        if binding is not None:
            for prim in prims:
                _author_binding(prim, binding, level)
        self._velocities = _primvar(splats.GetPrim(), "velocities", Sdf.ValueTypeNames.Vector3fArray)
        colors = [_primvar(prim, "displayColor", Sdf.ValueTypeNames.Color3fArray) for prim in prims]
        for color in colors:
            color.SetColorSpace(LINEAR_REC709)
        opacities = [_primvar(prim, "displayOpacity", Sdf.ValueTypeNames.FloatArray) for prim in prims]
        harmonics = self._splat_attribute("RadianceSphericalHarmonicsCoefficients")
        harmonics.SetMetadata("elementSize", harmonics_count)
        harmonics.SetMetadata("interpolation", UsdGeom.Tokens.vertex)

        def shared(*attributes: Usd.Attribute) -> SharedValue:
            return SharedValue(timeline, first_frame, *attributes)

        self._instance_scales = shared(self._instancer.CreateScalesAttr())
        self._scales = shared(self._splat_attribute("Scales"))
        self._harmonics = shared(harmonics)
        self._colors = shared(*colors)
        # Of what is float in any case, splats and instances share one array.
        self._opacities = shared(*opacities, *([] if half else [self._splat_attribute("Opacities")]))
        self._half_opacities = shared(self._splat_attribute("Opacities")) if half else None

    def _splat_attribute(self, name: str) -> Usd.Attribute:
        """Return an attribute of the splats in the precision of the export."""
        return getattr(self._splats, f"Create{name}{'h' if self._half else ''}Attr")()

    def _define_instancer(self, stage: Usd.Stage) -> None:
        """Author what never changes: the unit sphere, ids, and what the scales mean."""
        instancer, count = self._instancer, len(self._level.ids)
        sphere_path = instancer.GetPath().AppendPath("prototypes/ellipsoid")
        UsdGeom.Scope.Define(stage, sphere_path.GetParentPath())
        sphere = UsdGeom.Sphere.Define(stage, sphere_path)
        sphere.CreateRadiusAttr(1.0)
        sphere.CreateExtentAttr([Gf.Vec3f(-1), Gf.Vec3f(1)])
        instancer.CreatePrototypesRel().SetTargets([sphere_path])
        instancer.CreateProtoIndicesAttr(Vt.IntArray.FromNumpy(np.zeros(count, np.int32)))
        instancer.CreateIdsAttr(Vt.Int64Array.FromNumpy(self._level.ids))
        _author_ids(instancer.GetPrim(), self._level)
        instancer.GetPrim().SetCustomDataByKey("dsar:sigmaScale", SIGMA_SCALE)

    def _define_splats(self, harmonics_count: int) -> None:
        """Author what never changes: ids, degree, hints, and how colours are meant."""
        splats = self._splats
        _author_ids(splats.GetPrim(), self._level)
        splats.CreateRadianceSphericalHarmonicsDegreeAttr(round(harmonics_count**0.5) - 1)
        splats.CreateProjectionModeHintAttr(UsdVol.Tokens.perspective)
        splats.CreateSortingModeHintAttr(UsdVol.Tokens.zDepth)
        Usd.ColorSpaceAPI.Apply(splats.GetPrim()).CreateColorSpaceNameAttr(COLOR_SPACE)
        splats.GetPrim().SetCustomDataByKey("dsar:colorSpace", COLOR_SPACE)
        splats.GetPrim().SetCustomDataByKey("dsar:radiance", "color = max(0, harmonics . basis + 0.5)")

    def write(self, number: int, frame: ParticleFrame) -> Float32[np.ndarray, "2 3"]:
        """Write one frame of the full set to both prims and return this level's bounds."""
        instancer, splats = self._instancer, self._splats
        frame = self._level.select(frame)
        means = Vt.Vec3fArray.FromNumpy(frame.means)
        half_rotations = Vt.QuathArray.FromNumpy(frame.half_xyzw)
        speeds = Vt.Vec3fArray.FromNumpy(frame.velocities)
        bounds = frame.bounds()
        extent = Vt.Vec3fArray.FromNumpy(bounds)
        samples: list[tuple[Usd.Attribute, Any]] = [
            (instancer.CreatePositionsAttr(), means),
            (splats.CreatePositionsAttr(), means),
            (instancer.CreateOrientationsAttr(), half_rotations),
            (instancer.CreateVelocitiesAttr(), speeds),
            (self._velocities, speeds),
            (instancer.CreateExtentAttr(), extent),
            (splats.CreateExtentAttr(), extent),
        ]
        if self._half:
            samples.append((splats.CreateOrientationshAttr(), half_rotations))
        else:
            rotations = Vt.QuatfArray.FromNumpy(frame.xyzw)
            samples.append((instancer.CreateOrientationsfAttr(), rotations))
            samples.append((splats.CreateOrientationsAttr(), rotations))
        for attribute, value in samples:
            self._timeline.sample(attribute, number, value)
        self._write_appearance(number, frame)
        return bounds

    def _write_appearance(self, number: int, frame: ParticleFrame) -> None:
        """Write what may stay the same over all frames."""
        precision = np.float16 if self._half else np.float32
        vectors, numbers = (Vt.Vec3hArray, Vt.HalfArray) if self._half else (Vt.Vec3fArray, Vt.FloatArray)
        harmonics = frame.harmonics.reshape(-1, 3)
        self._scales.write(number, frame.scales.astype(precision, copy=False), vectors)
        self._instance_scales.write(number, frame.scales * np.float32(SIGMA_SCALE), Vt.Vec3fArray)
        self._harmonics.write(number, harmonics.astype(precision, copy=False), vectors)
        self._opacities.write(number, frame.opacities, Vt.FloatArray)
        if self._half_opacities is not None:
            self._half_opacities.write(number, frame.opacities.astype(precision), numbers)
        self._colors.write(number, frame.colors, Vt.Vec3fArray)


def _author_ids(prim: Usd.Prim, level: Level) -> None:
    """Author ids that shaders can read, which the schemas' own ids are not."""
    ids = Vt.IntArray.FromNumpy(level.ids.astype(np.int32))
    _primvar(prim, "id", Sdf.ValueTypeNames.IntArray).Set(ids)


def _author_binding(prim: Usd.Prim, binding: Binding, level: Level) -> None:
    """Author where Gaussians lie at rest and on the texture, and which joints carry them.

    For tools that bind them anew. Not under the names of UsdSkel, which would skin what is posed already.
    """
    ids = torch.from_numpy(level.ids)
    indices, weights = largest_influences(binding.weights[ids], INFLUENCES)
    points = binding.points[ids].float().contiguous().numpy()
    uv = binding.uv[ids].float().contiguous().numpy()
    types = Sdf.ValueTypeNames
    _primvar(prim, "restPosition", types.Point3fArray).Set(Vt.Vec3fArray.FromNumpy(points))
    _primvar(prim, "st", types.TexCoord2fArray).Set(Vt.Vec2fArray.FromNumpy(uv))
    for name, kind, value in (
        ("jointIndices", types.IntArray, Vt.IntArray.FromNumpy(indices.ravel())),
        ("jointWeights", types.FloatArray, Vt.FloatArray.FromNumpy(weights.ravel())),
    ):
        attribute = _primvar(prim, name, kind)
        attribute.Set(value)
        UsdGeom.Primvar(attribute).SetElementSize(INFLUENCES)


def _primvar(prim: Usd.Prim, name: str, kind: Sdf.ValueTypeName) -> Usd.Attribute:
    """Return the attribute of a primvar with one value per particle."""
    return UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, kind, UsdGeom.Tokens.vertex).GetAttr()
