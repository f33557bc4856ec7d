"""What must be true of a USD file with Gaussians, whoever wrote it.

USD's own validators check neither the lengths of arrays nor any value. Imports pxr.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdVol

from dsar.errors import ExportError
from dsar_exporters.usd.particles import EXTENT_SIGMAS, axis_extents
from dsar_exporters.usd.stages import diagnostics_held, open_stage, reason

_logger = logging.getLogger(__name__)

_OPEN_EVERYTHING = {
    "usdUtilsValidators:MissingReferenceValidator",
    "usdUtilsValidators:UsdzPackageValidator",
}
"""They open every file that a stage depends on: of 10,000 value clips, 800 MB at a time."""
_UNIT = 4e-3
"""How far a quaternion's length may be from 1: the rounding of 16 bits."""
_REACH = 1e-4
"""Metres that a Gaussian may reach beyond its extent: rounding."""


def refuse_faults(path: Path, frames: Sequence[int]) -> None:
    """Check a file that was just written, at some of its frames.

    Raises:
        ExportError: It has faults.
    """
    faults = list(usd_faults(path, frames))
    if faults:
        raise ExportError(
            f"{path.name}: expected a sound file, found {len(faults)} faults in what was just written: "
            f"{'; '.join(faults[:3])}: our writer or this usd-core is at fault, please report both"
        )


def usd_faults(path: Path, frames: Sequence[int] | None = None) -> Iterator[str]:
    """Yield what is wrong with a USD file, in words.

    Args:
        path: Any USD file; every point instancer and Gaussian field that it draws is checked, through
            references, payloads and instances (a prototype once), in all levels of detail of the default
            prim. Of instancers that are not of Gaussians, what holds for all.
        frames: Check these frames, and open no file that they do not need; None: all time samples.

    Raises:
        ExportError: It cannot be opened.
    """
    with diagnostics_held():
        stage = open_stage(path)
        yield from _validator_errors(stage, whole=frames is None)
        found = False
        for selected in _each_lod(stage):
            for prim, others in _drawn(stage):
                found = True
                where = f"{prim.GetPath()}{f' and {others} instances more' if others else ''}{selected}"
                yield from _prim_faults(prim, where, frames)
        if not found:
            yield "no point instancer and no Gaussian field: nothing in it is ours to check"


def _drawn(stage: Usd.Stage) -> Iterator[tuple[Usd.Prim, int]]:
    """Yield the prims to check, each once, and how many instances more of it the stage draws."""
    groups: dict[Sdf.Path, list[Usd.Prim]] = {}
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.PointInstancer) or prim.IsA(UsdVol.ParticleField3DGaussianSplat):
            source = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
            groups.setdefault(source.GetPath(), []).append(prim)
    for prims in groups.values():
        yield prims[0], len(prims) - 1


def _prim_faults(prim: Usd.Prim, where: str, frames: Sequence[int] | None) -> Iterator[str]:
    try:
        if prim.IsA(UsdGeom.PointInstancer):
            yield from _instancer_faults(UsdGeom.PointInstancer(prim), where, frames)
        else:
            yield from _splat_faults(UsdVol.ParticleField3DGaussianSplat(prim), where, frames)
    except Tf.ErrorException as error:
        yield f"{where}: expected values that USD can read, found: {reason(error)}"


def _validator_errors(stage: Usd.Stage, *, whole: bool) -> Iterator[str]:
    try:
        from pxr import UsdValidation
    except ImportError:
        _logger.warning("USD's own validators were not run: this usd-core has no UsdValidation")
        yield from (f"CompositionError: {error}" for error in stage.GetCompositionErrors())
        return
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    if not whole:
        validators = [each for each in validators if each.GetMetadata().name not in _OPEN_EVERYTHING]
    try:
        errors = UsdValidation.ValidationContext(validators).Validate(stage)
    except Tf.ErrorException as error:
        # Validators run beside each other, and which error comes first is chance; the stage names the file.
        said = [str(each) for each in stage.GetCompositionErrors()] or [reason(error)]
        what = "expected files that USD can open, found one that it depends on broken"
        yield from (f"{what}: {' '.join(each.split())}" for each in said)
        return
    for error in errors:
        yield f"{error.GetName()}: {error.GetMessage()}"


def _each_lod(stage: Usd.Stage) -> Iterator[str]:
    """Select every level of detail in turn, in the session only, and yield a text that names it."""
    root = stage.GetDefaultPrim()
    levels = root.GetVariantSet("lod").GetVariantNames() if root else []
    if not levels:
        yield ""
        return
    chosen = root.GetVariantSet("lod").GetVariantSelection()
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        # The default first: it was composed when the stage was opened.
        for level in sorted(levels, key=lambda name: name != chosen):
            root.GetVariantSet("lod").SetVariantSelection(level)
            yield f" (lod {level})"


@dataclass(frozen=True)
class _Fields:
    """Values of a prim at one time, as arrays; None where it has none."""

    positions: np.ndarray | None
    rotations: np.ndarray | None
    """wxyz."""
    scales: np.ndarray | None
    """Standard deviations."""
    extent: np.ndarray | None


def _instancer_faults(
    prim: UsdGeom.PointInstancer, where: str, frames: Sequence[int] | None
) -> Iterator[str]:
    # Without it, instances are whatever their prototypes are.
    sigmas = prim.GetPrim().GetCustomDataByKey("dsar:sigmaScale")
    prototypes = len(prim.GetPrototypesRel().GetTargets())
    for time in _times(prim.GetPrim(), frames):
        at = _at(where, time)
        indices = np.array(prim.GetProtoIndicesAttr().Get(time) or [], np.int64)
        count = len(indices)
        if count and not (0 <= indices.min() and indices.max() < prototypes):
            yield f"{at}: expected protoIndices below {prototypes}, found {indices.min()} to {indices.max()}"
        yield from _id_faults(prim.GetIdsAttr().Get(time), count, at)
        orientations = prim.GetOrientationsfAttr().Get(time) if _has_float_orientations(prim) else None
        orientations = orientations or prim.GetOrientationsAttr().Get(time)
        scales = _array(prim.GetScalesAttr().Get(time))
        fields = _Fields(
            positions=_array(prim.GetPositionsAttr().Get(time)),
            rotations=_wxyz(orientations),
            scales=scales if scales is None or sigmas is None else scales / np.float32(sigmas),
            extent=_array(prim.GetExtentAttr().Get(time)),
        )
        yield from _field_faults(fields, count, at, gaussians=sigmas is not None)
        yield from _length_faults({"velocities": prim.GetVelocitiesAttr().Get(time)}, count, at)
        yield from _display_faults(prim.GetPrim(), time, count, at)


def _splat_faults(
    prim: UsdVol.ParticleField3DGaussianSplat, where: str, frames: Sequence[int] | None
) -> Iterator[str]:
    def value(name: str, time: Usd.TimeCode) -> Any:
        """Return a field in the precision that readers prefer."""
        full = getattr(prim, f"Get{name}Attr")().Get(time)
        return getattr(prim, f"Get{name}hAttr")().Get(time) if full is None else full

    degree = prim.GetRadianceSphericalHarmonicsDegreeAttr().Get()
    for time in _times(prim.GetPrim(), frames):
        at, count = _at(where, time), len(value("Positions", time) or ())
        fields = _Fields(
            positions=_array(value("Positions", time)),
            rotations=_wxyz(value("Orientations", time)),
            scales=_array(value("Scales", time)),
            extent=_array(prim.GetExtentAttr().Get(time)),
        )
        yield from _field_faults(fields, count, at, gaussians=True)
        opacities = _array(value("Opacities", time))
        harmonics = _array(value("RadianceSphericalHarmonicsCoefficients", time))
        yield from _length_faults({"opacities": opacities}, count, at)
        yield from _length_faults({"harmonics": harmonics}, count * (degree + 1) ** 2, at)
        yield from _finite_faults({"opacities": opacities, "harmonics": harmonics}, at)
        if opacities is not None and len(opacities) and not 0 <= opacities.min() <= opacities.max() <= 1:
            yield f"{at}: expected opacities from 0 to 1, found {opacities.min():g} to {opacities.max():g}"
        yield from _display_faults(prim.GetPrim(), time, count, at)


def _at(where: str, time: Usd.TimeCode) -> str:
    return where if time.IsDefault() else f"{where} at {time.GetValue():g}"


def _field_faults(fields: _Fields, count: int, at: str, *, gaussians: bool) -> Iterator[str]:
    """Yield what is wrong with positions, rotations, scales and extent at one time."""
    named = {"positions": fields.positions, "orientations": fields.rotations, "scales": fields.scales}
    needed = named if gaussians else ("positions",)
    missing = [name for name in needed if named[name] is None]
    if missing:
        yield f"{at}: expected {', '.join(missing)}, found none"
        return
    faults = [*_length_faults(named, count, at), *_finite_faults(named, at)]
    yield from faults
    if faults or not count:
        return
    if fields.rotations is not None:
        lengths = np.linalg.norm(fields.rotations, axis=1)
        if np.abs(lengths - 1).max() > _UNIT:
            yield f"{at}: expected unit quaternions, found lengths {lengths.min():g} to {lengths.max():g}"
    if fields.extent is None:
        yield f"{at}: expected an extent, found none: applications could not frame or cull it"
    elif fields.extent.shape != (2, 3) or not np.isfinite(fields.extent).all():
        yield f"{at}: expected an extent of two finite corners, found {fields.extent.tolist()}"
    elif gaussians:
        yield from _reach_faults(fields, at)


def _reach_faults(fields: _Fields, at: str) -> Iterator[str]:
    """Yield what is wrong with the size of Gaussians, and with the extent that must hold them."""
    assert fields.positions is not None
    assert fields.rotations is not None
    assert fields.scales is not None
    if fields.scales.min() <= 0:
        yield f"{at}: expected scales above 0, found {fields.scales.min():g}"
    if fields.extent is None:
        return
    rotations = fields.rotations / np.linalg.norm(fields.rotations, axis=1, keepdims=True)
    reach = axis_extents(rotations, fields.scales)
    low, high = (fields.positions - reach).min(0), (fields.positions + reach).max(0)
    slack = _REACH + 2e-3 * float(fields.scales.max())
    if (fields.extent[0] > low + slack).any() or (fields.extent[1] < high - slack).any():
        yield (
            f"{at}: expected an extent that holds {EXTENT_SIGMAS:g} standard deviations, "
            f"{[low.tolist(), high.tolist()]}, found {fields.extent.tolist()}"
        )


def _display_faults(prim: Usd.Prim, time: Usd.TimeCode, count: int, at: str) -> Iterator[str]:
    """Yield what is wrong with the primvars that applications draw with."""
    primvars = UsdGeom.PrimvarsAPI(prim)
    for name in ("displayColor", "displayOpacity", "id", "velocities"):
        primvar = primvars.GetPrimvar(name)
        if primvar and primvar.GetInterpolation() == UsdGeom.Tokens.vertex:
            yield from _length_faults({f"primvars:{name}": primvar.Get(time)}, count, at)


def _length_faults(named: dict[str, Any], count: int, at: str) -> Iterator[str]:
    for name, values in named.items():
        if values is not None and len(values) != count:
            yield f"{at}: expected {count} {name}, found {len(values)}"


def _finite_faults(named: dict[str, np.ndarray | None], at: str) -> Iterator[str]:
    for name, values in named.items():
        broken = 0 if values is None else int((~np.isfinite(values)).sum())
        if broken:
            yield f"{at}: expected finite {name}, found {broken} values that are not"


def _id_faults(ids: Any, count: int, where: str) -> Iterator[str]:
    if ids is None:
        return
    if len(ids) != count:
        yield f"{where}: expected {count} ids, found {len(ids)}"
    elif len(set(ids)) != count:
        yield f"{where}: expected each id once, found {count - len(set(ids))} again"


def _times(prim: Usd.Prim, frames: Sequence[int] | None) -> Sequence[Usd.TimeCode]:
    """Return the times to check: some frames, those of any sample, or the default."""
    # The samples of value clips are asked for only if need be: that opens every clip.
    found = frames
    if found is None:
        found = sorted(
            {time for attribute in prim.GetAuthoredAttributes() for time in attribute.GetTimeSamples()}
        )
    return [Usd.TimeCode(time) for time in found] or [Usd.TimeCode.Default()]


def _has_float_orientations(prim: UsdGeom.PointInstancer) -> bool:
    return hasattr(prim, "GetOrientationsfAttr") and prim.GetOrientationsfAttr().HasAuthoredValue()


def _array(value: Any) -> np.ndarray | None:
    return None if value is None else np.array(value, np.float32)


def _wxyz(value: Any) -> np.ndarray | None:
    """Return quaternions as an array; Vt's buffers hold them xyzw."""
    return None if value is None else np.array(value, np.float32).reshape(-1, 4)[:, [3, 0, 1, 2]]
