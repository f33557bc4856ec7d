"""The Gaussians of a rollout as time samples, for two USD schemas at once.

Imports pxr: only `write_usd`'s modules import this one.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from pxr import Gf, Sdf, Usd, UsdGeom, UsdVol, Vt

from dsar.geometry.harmonics import C0
from dsar.geometry.rotations import matrix_from_quaternion
from dsar.types import Gaussians, GaussianSequence
from dsar_exporters.checks import checked_frames
from dsar_exporters.color import LINEAR_REC709, linear_from_srgb

# An ellipsoid of two standard deviations looks about as large as the splat.
_SIGMA_SCALE = 2.0
_EXTENT_SIGMAS = 3.0


def author_particles(stage: Usd.Stage, sequence: GaussianSequence) -> Float32[np.ndarray, "2 3"]:
    """Author both representations under the default prim; return the bounds over all frames.

    Two frames are in memory at a time apart from what USD holds.

    Args:
        stage: Its default prim becomes the parent of `instancer` and `splats`.
        sequence: The frames; they become time codes.

    Raises:
        ExportError: A frame is not fit for export.
    """
    writer = None
    bounds = []
    for frame, gaussians, velocities in _frames_with_velocities(sequence):
        writer = writer or _ParticleWriter(stage, gaussians, first_frame=frame)
        bounds.append(writer.write(frame, gaussians, velocities))
    lower, upper = np.stack(bounds).min(0)[0], np.stack(bounds).max(0)[1]
    return np.stack([lower, upper])


def _frames_with_velocities(
    sequence: GaussianSequence,
) -> Iterator[tuple[int, Gaussians, torch.Tensor]]:
    """Yield each frame with its velocities in metres per second.

    Velocities are forward differences, so that an application that extrapolates from a sample arrives at
    the next one; the last frame repeats those before it. Quaternions stay in the hemisphere of the frame
    before, so that interpolation takes the short way.
    """
    earlier: tuple[int, Gaussians] | None = None
    velocities = None
    for frame, gaussians in checked_frames(sequence):
        if earlier is not None:
            earlier_frame, before = earlier
            flipped = (gaussians.rotations * before.rotations).sum(-1, keepdim=True) < 0
            rotations = torch.where(flipped, -gaussians.rotations, gaussians.rotations)
            gaussians = Gaussians(
                gaussians.means, rotations, gaussians.scales, gaussians.opacities, gaussians.harmonics
            )
            velocities = (gaussians.means - before.means) * (sequence.fps / (frame - earlier_frame))
            yield earlier_frame, before, velocities
        earlier = frame, gaussians
    if earlier is not None:
        yield *earlier, torch.zeros_like(earlier[1].means) if velocities is None else velocities


class _Values:
    """Attributes that share one value: written once while it stays, as time samples once it changes."""

    def __init__(self, first_frame: int, *attributes: Usd.Attribute) -> None:
        self._attributes = attributes
        self._first_frame = self._last_frame = first_frame
        self._value: np.ndarray | None = None
        self._changes = False

    def write(self, frame: int, value: np.ndarray, array: Any) -> None:
        """Write the value of a frame; `array` is the Vt type that holds it."""
        if self._value is None:
            self._set(array.FromNumpy(value), Usd.TimeCode.Default())
        elif not self._changes and not np.array_equal(value, self._value):
            self._changes = True
            for attribute in self._attributes:
                attribute.ClearDefault()
            # The old value holds up to the frame before this one.
            for held_frame in {self._first_frame, self._last_frame}:
                self._set(array.FromNumpy(self._value), held_frame)
        if self._changes:
            self._set(array.FromNumpy(value), frame)
        self._value, self._last_frame = value, frame

    def _set(self, value: Any, time: int | Usd.TimeCode) -> None:
        for attribute in self._attributes:
            attribute.Set(value, time)


class _ParticleWriter:
    """A PointInstancer and a ParticleField3DGaussianSplat that receive the same frames."""

    def __init__(self, stage: Usd.Stage, gaussians: Gaussians, *, first_frame: int) -> None:
        root = stage.GetDefaultPrim().GetPath()
        self._instancer = UsdGeom.PointInstancer.Define(stage, root.AppendChild("instancer"))
        self._splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, root.AppendChild("splats"))
        harmonics_count = gaussians.harmonics.shape[1]
        self._define_instancer(stage, len(gaussians))
        self._define_splats(len(gaussians), harmonics_count)
        splats = self._splats
        prims = (self._instancer.GetPrim(), splats.GetPrim())
        self._velocities = _primvar(splats.GetPrim(), "velocities", Sdf.ValueTypeNames.Vector3fArray)
        colors = [_primvar(prim, "displayColor", Sdf.ValueTypeNames.Color3fArray) for prim in prims]
        for color in colors:
            color.SetColorSpace(LINEAR_REC709)
        opacities = [_primvar(prim, "displayOpacity", Sdf.ValueTypeNames.FloatArray) for prim in prims]
        harmonics = splats.CreateRadianceSphericalHarmonicsCoefficientsAttr()
        harmonics.SetMetadata("elementSize", harmonics_count)
        harmonics.SetMetadata("interpolation", UsdGeom.Tokens.vertex)
        self._instance_scales = _Values(first_frame, self._instancer.CreateScalesAttr())
        self._scales = _Values(first_frame, splats.CreateScalesAttr())
        self._opacities = _Values(first_frame, splats.CreateOpacitiesAttr(), *opacities)
        self._harmonics = _Values(first_frame, harmonics)
        self._colors = _Values(first_frame, *colors)

    def _define_instancer(self, stage: Usd.Stage, count: int) -> None:
        """Author what never changes: the unit sphere, ids, and what the scales mean."""
        instancer = self._instancer
        sphere_path = instancer.GetPath().AppendPath("prototypes/ellipsoid")
        UsdGeom.Scope.Define(stage, sphere_path.GetParentPath())
        sphere = UsdGeom.Sphere.Define(stage, sphere_path)
        sphere.CreateRadiusAttr(1.0)
        sphere.CreateExtentAttr([Gf.Vec3f(-1), Gf.Vec3f(1)])
        instancer.CreatePrototypesRel().SetTargets([sphere_path])
        instancer.CreateProtoIndicesAttr(Vt.IntArray.FromNumpy(np.zeros(count, np.int32)))
        instancer.CreateIdsAttr(Vt.Int64Array.FromNumpy(np.arange(count, dtype=np.int64)))
        _author_ids(instancer.GetPrim(), count)
        instancer.GetPrim().SetCustomDataByKey("dsar:sigmaScale", _SIGMA_SCALE)

    def _define_splats(self, count: int, harmonics_count: int) -> None:
        """Author what never changes: ids, degree, hints, and how colours are meant."""
        splats = self._splats
        _author_ids(splats.GetPrim(), count)
        splats.CreateRadianceSphericalHarmonicsDegreeAttr(round(harmonics_count**0.5) - 1)
        splats.CreateProjectionModeHintAttr(UsdVol.Tokens.perspective)
        splats.CreateSortingModeHintAttr(UsdVol.Tokens.zDepth)
        # The Color Interop Forum's id, as other splat writers use it; Gf has no display-referred names yet.
        space = "srgb_rec709_display"
        Usd.ColorSpaceAPI.Apply(splats.GetPrim()).CreateColorSpaceNameAttr(space)
        splats.GetPrim().SetCustomDataByKey("dsar:colorSpace", space)
        splats.GetPrim().SetCustomDataByKey("dsar:radiance", "color = max(0, harmonics . basis + 0.5)")

    def write(self, frame: int, gaussians: Gaussians, velocities: torch.Tensor) -> Float32[np.ndarray, "2 3"]:
        """Write one frame to both prims and return its bounds."""
        instancer, splats = self._instancer, self._splats
        means = Vt.Vec3fArray.FromNumpy(gaussians.means.numpy())
        # Vt's buffers hold quaternions xyzw.
        xyzw = gaussians.rotations[:, [1, 2, 3, 0]].numpy()
        rotations = Vt.QuatfArray.FromNumpy(xyzw)
        speeds = Vt.Vec3fArray.FromNumpy(velocities.numpy())
        bounds = _bounds(gaussians)
        for attribute, value in (
            (instancer.CreatePositionsAttr(), means),
            (splats.CreatePositionsAttr(), means),
            (instancer.CreateOrientationsAttr(), Vt.QuathArray.FromNumpy(xyzw.astype(np.float16))),
            (instancer.CreateOrientationsfAttr(), rotations),
            (splats.CreateOrientationsAttr(), rotations),
            (instancer.CreateVelocitiesAttr(), speeds),
            (self._velocities, speeds),
            (instancer.CreateExtentAttr(), Vt.Vec3fArray.FromNumpy(bounds)),
            (splats.CreateExtentAttr(), Vt.Vec3fArray.FromNumpy(bounds)),
        ):
            attribute.Set(value, frame)
        scales = gaussians.scales.numpy()
        dc = gaussians.harmonics[:, 0].numpy()
        self._scales.write(frame, scales, Vt.Vec3fArray)
        self._instance_scales.write(frame, scales * np.float32(_SIGMA_SCALE), Vt.Vec3fArray)
        self._opacities.write(frame, gaussians.opacities.numpy(), Vt.FloatArray)
        self._harmonics.write(frame, gaussians.harmonics.reshape(-1, 3).numpy(), Vt.Vec3fArray)
        self._colors.write(frame, linear_from_srgb(dc * np.float32(C0) + np.float32(0.5)), Vt.Vec3fArray)
        return bounds


def _author_ids(prim: Usd.Prim, count: int) -> None:
    """Author ids that shaders can read, which the schemas' own ids are not."""
    ids = Vt.IntArray.FromNumpy(np.arange(count, dtype=np.int32))
    _primvar(prim, "id", Sdf.ValueTypeNames.IntArray).Set(ids)


def _primvar(prim: Usd.Prim, name: str, kind: Sdf.ValueTypeName) -> Usd.Attribute:
    """Return the attribute of a primvar with one value per particle."""
    return UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, kind, UsdGeom.Tokens.vertex).GetAttr()


def _bounds(gaussians: Gaussians) -> Float32[np.ndarray, "2 3"]:
    """Return the lower and upper corner, metres, of all Gaussians out to three standard deviations."""
    if not len(gaussians):
        return np.zeros((2, 3), np.float32)
    axes = matrix_from_quaternion(gaussians.rotations) * gaussians.scales[:, None, :]
    reach = _EXTENT_SIGMAS * axes.norm(dim=-1)
    lower, upper = (gaussians.means - reach).amin(0), (gaussians.means + reach).amax(0)
    return torch.stack([lower, upper]).numpy()
