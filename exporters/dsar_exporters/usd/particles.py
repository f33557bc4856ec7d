"""The Gaussians of a rollout over time, for two USD schemas at once.

Imports pxr: only the writers of an asset import this module.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float16, Float32, Int64
from pxr import Gf, Sdf, Usd, UsdGeom, UsdVol, Vt

from dsar.color import linear_from_srgb
from dsar.geometry.harmonics import C0
from dsar.types import Binding, Gaussians
from dsar_exporters.color import LINEAR_REC709
from dsar_exporters.usd.timeline import Timeline, Values

INSTANCER, SPLATS = "instancer", "splats"
SIGMA_SCALE = 2.0
"""Standard deviations to the surface of an ellipsoid: it then looks about as large as the splat."""
EXTENT_SIGMAS = 3.0
INFLUENCES = 4
"""Joints that a Gaussian's authored skin weights name, the largest ones."""
_MIN_SCALE = np.float32(1e-8)
"""Metres: the schema has no Gaussians without extent."""
COLOR_SPACE = "srgb_rec709_display"
"""The Color Interop Forum's id, as other splat writers use it; Gf has no display-referred names yet."""


@dataclass(frozen=True)
class Level:
    """A level of detail: some of the Gaussians, enlarged to cover for the others."""

    name: str
    ids: Int64[np.ndarray, " m"]
    """Indices into the full set: the ids that every level shares."""
    enlargement: float
    """Factor on standard deviations, which keeps the area that is covered."""

    def of(self, frame: "Frame") -> "Frame":
        """Return this level's share of a frame."""
        if len(self.ids) == len(frame.means):
            return frame
        chosen = {name: values.take(self.ids, 0) for name, values in vars(frame).items()}
        grown = np.float32(self.enlargement)
        return Frame(**{**chosen, "scales": chosen["scales"] * grown, "reach": chosen["reach"] * grown})


@dataclass(frozen=True)
class Frame:
    """Everything that one frame's prims hold of the Gaussians, as arrays in USD's order."""

    means: Float32[np.ndarray, "n 3"]
    xyzw: Float32[np.ndarray, "n 4"]
    """Quaternions as Vt's buffers hold them."""
    half_xyzw: Float16[np.ndarray, "n 4"]
    velocities: Float32[np.ndarray, "n 3"]
    """Metres per second."""
    scales: Float32[np.ndarray, "n 3"]
    opacities: Float32[np.ndarray, " n"]
    harmonics: Float32[np.ndarray, "n k 3"]
    colors: Float32[np.ndarray, "n 3"]
    """Linear, without what depends on the view."""
    reach: Float32[np.ndarray, "n 3"]
    """How far three standard deviations extend along the world's axes, metres."""

    @classmethod
    def of(cls, gaussians: Gaussians, velocities: Float32[torch.Tensor, "n 3"]) -> "Frame":
        """Return a frame's arrays."""
        xyzw = gaussians.rotations[:, [1, 2, 3, 0]].numpy()
        dc = gaussians.harmonics[:, 0].numpy()
        return cls(
            means=gaussians.means.numpy(),
            xyzw=xyzw,
            half_xyzw=xyzw.astype(np.float16),
            velocities=velocities.contiguous().numpy(),
            scales=np.maximum(gaussians.scales.numpy(), _MIN_SCALE),
            opacities=gaussians.opacities.numpy(),
            harmonics=gaussians.harmonics.numpy(),
            colors=linear_from_srgb(dc * np.float32(C0) + np.float32(0.5)),
            reach=axis_extents(gaussians.rotations.numpy(), gaussians.scales.numpy()),
        )

    def bounds(self) -> Float32[np.ndarray, "2 3"]:
        """Return the lower and upper corner, metres, of all Gaussians out to three standard deviations."""
        if not len(self.means):
            return np.zeros((2, 3), np.float32)
        return np.stack([(self.means - self.reach).min(0), (self.means + self.reach).max(0)])


def make_levels(points: Float32[np.ndarray, "n 3"]) -> list[Level]:
    """Return the levels full, half and quarter of Gaussians that lie at these points at rest.

    The points are put in the order of a space-filling curve, of which every second or fourth is kept: thinned
    evenly, and the quarter is part of the half.
    """
    order = _along_curve(points)
    return [
        Level("full", np.arange(len(points)), 1.0),
        Level("half", np.sort(order[::2]), 2**0.5),
        Level("quarter", np.sort(order[::4]), 2.0),
    ]


def _along_curve(points: Float32[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """Return points' indices in Morton order."""
    if not len(points):
        return np.zeros(0, np.int64)
    span = max(float(np.ptp(points, axis=0).max()), 1e-9)
    cells = ((points - points.min(0)) / span * 1023).astype(np.uint64)
    codes = np.zeros(len(points), np.uint64)
    for bit in range(10):
        for axis in range(3):
            codes |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(codes, kind="stable")


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
        harmonics = self._own("RadianceSphericalHarmonicsCoefficients")
        harmonics.SetMetadata("elementSize", harmonics_count)
        harmonics.SetMetadata("interpolation", UsdGeom.Tokens.vertex)

        def values(*attributes: Usd.Attribute) -> Values:
            return Values(timeline, first_frame, *attributes)

        self._instance_scales = values(self._instancer.CreateScalesAttr())
        self._scales = values(self._own("Scales"))
        self._harmonics = values(harmonics)
        self._colors = values(*colors)
        # Of what is float in any case, splats and instances share one array.
        self._opacities = values(*opacities, *([] if half else [self._own("Opacities")]))
        self._half_opacities = values(self._own("Opacities")) if half else None

    def _own(self, name: str) -> Usd.Attribute:
        """Return an attribute of the splats in the precision that was asked for."""
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

    def write(self, number: int, frame: Frame) -> Float32[np.ndarray, "2 3"]:
        """Write one frame of the full set to both prims and return this level's bounds."""
        instancer, splats = self._instancer, self._splats
        frame = self._level.of(frame)
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

    def _write_appearance(self, number: int, frame: Frame) -> None:
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


def largest_influences(
    weights: Float32[torch.Tensor, "n j"], count: int
) -> tuple[np.ndarray, Float32[np.ndarray, "n c"]]:
    """Return each point's heaviest joints (int32) and their weights, which sum to 1."""
    found = weights.float().topk(min(count, weights.shape[1]), dim=1)
    shares = found.values / found.values.sum(1, keepdim=True)
    return found.indices.int().contiguous().numpy(), shares.contiguous().numpy()


def _primvar(prim: Usd.Prim, name: str, kind: Sdf.ValueTypeName) -> Usd.Attribute:
    """Return the attribute of a primvar with one value per particle."""
    return UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, kind, UsdGeom.Tokens.vertex).GetAttr()


def axis_extents(
    rotations: Float32[np.ndarray, "n 4"], scales: Float32[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Return how far three standard deviations extend along the world's axes, metres; quaternions are wxyz.

    The square of a standard deviation along an axis is the sum of squares of a row of R S.
    """
    w, x, y, z = rotations.T
    a, b, c = scales.T
    rows = (
        ((1 - 2 * (y * y + z * z)) * a, 2 * (x * y - w * z) * b, 2 * (x * z + w * y) * c),
        (2 * (x * y + w * z) * a, (1 - 2 * (x * x + z * z)) * b, 2 * (y * z - w * x) * c),
        (2 * (x * z - w * y) * a, 2 * (y * z + w * x) * b, (1 - 2 * (x * x + y * y)) * c),
    )
    squares = [p * p + q * q + r * r for p, q, r in rows]
    return np.float32(EXTENT_SIGMAS) * np.sqrt(np.stack(squares, -1))
