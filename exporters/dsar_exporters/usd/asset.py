"""The asset around the Gaussians: metadata, variants, payload, body and cameras.

A small root layer says what the asset is. Its data lie in a payload, each under a prim of its own that the
root's arcs bring in: `/full`, `/half` and `/quarter` (levels of detail), `/body`, `/turntable`.

Imports pxr: only `dsar_exporters.usd` imports this module, when it writes.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from pxr import Kind, Sdf, Usd, UsdGeom, Vt

from dsar.geometry.camera_paths import TURNTABLE, turntable
from dsar.types import Camera, Gaussians, GaussianSequence
from dsar_exporters.usd.body import BODY, MESH, BodyWriter
from dsar_exporters.usd.cameras import define_camera, world_matrix
from dsar_exporters.usd.levels import Level, make_levels
from dsar_exporters.usd.names import clips_folder, payload_path
from dsar_exporters.usd.particle_frame import ParticleFrame
from dsar_exporters.usd.particles import INSTANCER, SPLATS, ParticleWriter
from dsar_exporters.usd.timeline import ClipTimeline, LayerTimeline, Timeline

PROXY = "proxy"
_TURNTABLE_SIZE = (1080, 1080)
"""Pixels of the turntable where the asset has no camera to follow."""


class AssetWriter:
    """Writes the files of an asset, frame after frame.

    A frame is written when the one after it has come: velocities are forward differences, so that an
    application that extrapolates from a sample arrives at the next one; the last frame repeats those before
    it. Quaternions stay in the hemisphere of the frame before, so that interpolation takes the short way.
    """

    def __init__(
        self,
        sequence: GaussianSequence,
        path: Path,
        *,
        name: str,
        cameras: Sequence[Camera],
        half: bool,
        clips: bool,
    ) -> None:
        self._sequence, self._path, self._half = sequence, path, half
        self._stage = Usd.Stage.CreateNew(str(path))
        _describe(self._stage, sequence, name)
        if path.suffix.lower() == ".usda":
            self._payload_path = payload_path(path)
            self._data = Usd.Stage.CreateNew(str(self._payload_path))
            _describe(self._data, sequence, None)
            self._arc = f"./{self._payload_path.name}"
        else:
            self._payload_path, self._data, self._arc = path, self._stage, ""
        self._layer = LayerTimeline(self._data.GetRootLayer())
        self._clips = ClipTimeline(_make_folder(clips_folder(path)), path.stem) if clips else None
        self._levels: list[Level] = []
        self._particles: list[ParticleWriter] = []
        self._bounds: dict[str, Float32[np.ndarray, "2 3"]] = {}
        self._earlier: tuple[int, Gaussians] | None = None
        self._velocities: torch.Tensor | None = None
        self._count = 0
        self._author_cameras(cameras)
        self._body = self._author_body()

    @property
    def files(self) -> list[Path]:
        """The files that are to take their place, the root layer last; a folder stands for the clips."""
        clips = [] if self._clips is None else [self._clips.folder]
        return [*clips, *dict.fromkeys((self._payload_path, self._path))]

    def write(self, frame: int, gaussians: Gaussians) -> None:
        """Take a frame."""
        if self._earlier is None:
            self._author_levels(gaussians, frame)
        else:
            earlier_frame, before = self._earlier
            flipped = (gaussians.rotations * before.rotations).sum(-1, keepdim=True) < 0
            rotations = torch.where(flipped, -gaussians.rotations, gaussians.rotations)
            gaussians = Gaussians(
                gaussians.means, rotations, gaussians.scales, gaussians.opacities, gaussians.harmonics
            )
            seconds = (frame - earlier_frame) / self._sequence.fps
            self._velocities = (gaussians.means - before.means) / seconds
            self._write_earlier(self._velocities)
        self._earlier = frame, gaussians

    def close(self) -> None:
        """Write the last frame and save every file."""
        assert self._earlier is not None
        assert self._stage is not None
        still = torch.zeros_like(self._earlier[1].means)
        self._write_earlier(still if self._velocities is None else self._velocities)
        self._author_bounds()
        # A stage's own reference to its layer dies with it; these last.
        layers = [Sdf.Layer.FindOrOpen(s.GetRootLayer().identifier) for s in (self._data, self._stage)]
        # Stages would recompose, and open every clip, at each of the edits that bind clips.
        del self._particles, self._body, self._data, self._stage
        if self._clips is not None:
            self._clips.bind(layers[0], [f"/{level.name}" for level in self._levels])
        for layer in layers:
            _describe_guarded(layer, self._sequence)
            layer.Save()

    def _write_earlier(self, velocities: torch.Tensor) -> None:
        assert self._earlier is not None
        frame, gaussians = self._earlier
        values = ParticleFrame.from_gaussians(gaussians, velocities)
        for level, writer in zip(self._levels, self._particles, strict=True):
            bounds = writer.write(frame, values)
            so_far = self._bounds.get(level.name, bounds)
            widest = np.minimum(so_far[0], bounds[0]), np.maximum(so_far[1], bounds[1])
            self._bounds[level.name] = np.stack(widest)
        if self._body is not None:
            self._body.write(frame, self._count)
        self._count += 1
        if self._clips is not None:
            self._clips.end_frame(frame)
        self._layer.end_frame(frame)

    def _author_bounds(self) -> None:
        """Let applications frame the asset, at any level, before they load its payload."""
        model = UsdGeom.ModelAPI.Apply(self._stage.GetDefaultPrim())
        lods = model.GetPrim().GetVariantSet("lod")
        for level in reversed(self._levels):
            lods.SetVariantSelection(level.name)
            with lods.GetVariantEditContext():
                model.SetExtentsHint(Vt.Vec3fArray.FromNumpy(self._bounds[level.name]))

    def _author_levels(self, gaussians: Gaussians, frame: int) -> None:
        """Author the prims of the Gaussians, and the variants that choose among them."""
        binding = self._sequence.binding
        points = gaussians.means if binding is None else binding.points
        self._levels = make_levels(points.float().contiguous().numpy())
        timeline: Timeline = self._layer if self._clips is None else self._clips
        for level in self._levels:
            self._define_data(f"/{level.name}")
            self._particles.append(
                ParticleWriter(
                    self._data,
                    timeline,
                    level,
                    gaussians.harmonics.shape[1],
                    first_frame=frame,
                    half=self._half,
                    binding=binding,
                )
            )
        root = self._stage.GetDefaultPrim()
        lods = root.GetVariantSets().AddVariantSet("lod")
        for level in self._levels:
            lods.AddVariant(level.name)
            lods.SetVariantSelection(level.name)
            with lods.GetVariantEditContext():
                self._add_payload(root, f"/{level.name}")
        lods.SetVariantSelection(self._levels[0].name)
        self._author_representations()

    def _author_representations(self) -> None:
        """Author the variant set that shows one representation and hides the others."""
        root = self._stage.GetDefaultPrim()
        paths = {INSTANCER: INSTANCER, SPLATS: SPLATS}
        if self._sequence.binding is not None:
            paths[PROXY] = f"{BODY}/{MESH}"
        variants = root.GetVariantSets().AddVariantSet("representation")
        for name in paths:
            variants.AddVariant(name)
            variants.SetVariantSelection(name)
            with variants.GetVariantEditContext():
                for other, path in paths.items():
                    if other != name:
                        prim = self._stage.OverridePrim(root.GetPath().AppendPath(path))
                        UsdGeom.Imageable(prim).CreateVisibilityAttr(UsdGeom.Tokens.invisible)
        variants.SetVariantSelection(INSTANCER)

    def _author_body(self) -> BodyWriter | None:
        """Author the skeleton, if the sequence has a body."""
        binding = self._sequence.binding
        if binding is None:
            return None
        writer = BodyWriter(self._data, self._layer, binding)
        self._as_data(f"/{BODY}")
        root = self._stage.GetDefaultPrim()
        self._add_payload(self._stage.DefinePrim(root.GetPath().AppendChild(BODY)), f"/{BODY}")
        return writer

    def _author_cameras(self, cameras: Sequence[Camera]) -> None:
        """Author the capture's cameras, and the turntable."""
        sequence = self._sequence
        if not cameras and sequence.binding is None:
            return
        scope = UsdGeom.Scope.Define(
            self._stage, self._stage.GetDefaultPrim().GetPath().AppendChild("cameras")
        )
        for camera in cameras:
            transform = define_camera(self._stage, scope.GetPath().AppendChild(camera.name), camera)
            transform.Set(world_matrix(camera))
        if sequence.binding is not None:
            width, height = (cameras[0].width, cameras[0].height) if cameras else _TURNTABLE_SIZE
            orbit = turntable(
                sequence.binding, sequence.frame_numbers, sequence.fps, width=width, height=height
            )
            transform = define_camera(self._data, f"/{TURNTABLE}", orbit.cameras[0])
            for frame, camera in zip(sequence.frame_numbers, orbit.cameras, strict=True):
                self._layer.sample(transform, frame, world_matrix(camera))
            self._as_data(f"/{TURNTABLE}")
            prim = self._stage.DefinePrim(scope.GetPath().AppendChild(TURNTABLE))
            self._add_payload(prim, f"/{TURNTABLE}")

    def _define_data(self, path: str) -> None:
        UsdGeom.Xform.Define(self._data, path)
        self._as_data(path)

    def _as_data(self, path: str) -> None:
        """In a single file, make what the root brings in invisible where it stands."""
        if not self._arc:
            self._data.GetPrimAtPath(path).SetSpecifier(Sdf.SpecifierClass)

    def _add_payload(self, prim: Usd.Prim, path: str) -> None:
        """Let a prim of the root hold what lies at a path of the data."""
        if self._arc:
            prim.GetPayloads().AddPayload(self._arc, path)
        else:
            prim.GetPayloads().AddInternalPayload(path)


def _make_folder(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _describe(stage: Usd.Stage, sequence: GaussianSequence, name: str | None) -> None:
    """Author units, axes, time and provenance, and the default prim of the root layer."""
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetTimeCodesPerSecond(sequence.fps)
    stage.SetFramesPerSecond(sequence.fps)
    stage.SetStartTimeCode(sequence.frame_numbers[0])
    stage.SetEndTimeCode(sequence.frame_numbers[-1])
    stage.GetRootLayer().customLayerData = {"dsar": dict(sequence.provenance)}
    if name is None:
        stage.GetRootLayer().defaultPrim = "full"
        return
    root = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(root)
    model = Usd.ModelAPI(root)
    model.SetKind(Kind.Tokens.component)
    model.SetAssetName(name)
    model.SetAssetIdentifier(Sdf.AssetPath(f"./{Path(stage.GetRootLayer().realPath).name}"))
    if version := sequence.provenance.get("checkpoint"):
        model.SetAssetVersion(version)


def _describe_guarded(layer: Sdf.Layer, sequence: GaussianSequence) -> None:
    """Author what guards found, by frame number, beside the provenance; nothing where they found nothing."""
    if not sequence.guarded:
        return
    found = {str(number): frame.describe() for number, frame in sorted(sequence.guarded.items())}
    data = layer.customLayerData
    layer.customLayerData = {**data, "dsar": {**data["dsar"], "guarded": found}}
