"""What must be true of a USD file with Gaussians, whoever wrote it.

USD's own validators check neither the lengths of arrays nor any value. Imports pxr.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdVol

from dsar.errors import ExportError
from dsar_exporters.usd.particle_faults import (
    ParticleFields,
    as_array,
    as_wxyz,
    display_faults,
    field_faults,
    finite_faults,
    id_faults,
    length_faults,
)
from dsar_exporters.usd.stages import explain_usd_error, open_stage, warnings_withheld

_logger = logging.getLogger(__name__)

_OPEN_EVERYTHING = {
    "usdUtilsValidators:MissingReferenceValidator",
    "usdUtilsValidators:UsdzPackageValidator",
}
"""They open every file that a stage depends on: of 10,000 value clips, 800 MB at a time."""


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
    with warnings_withheld():
        stage = open_stage(path)
        yield from _validator_errors(stage, whole=frames is None)
        any_particles = False
        for selected in _select_each_lod(stage):
            for prim, others in _drawn_particles(stage):
                any_particles = True
                where = f"{prim.GetPath()}{f' and {others} instances more' if others else ''}{selected}"
                yield from _prim_faults(prim, where, frames)
        if not any_particles:
            yield "no point instancer and no Gaussian field: nothing in it is ours to check"


def _drawn_particles(stage: Usd.Stage) -> Iterator[tuple[Usd.Prim, int]]:
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
        yield f"{where}: expected values that USD can read, found: {explain_usd_error(error)}"


def _validator_errors(stage: Usd.Stage, *, whole: bool) -> Iterator[str]:
    try:
        from pxr import UsdValidation
    except ImportError:
        _logger.warning("USD's own validators were not run: this usd-core has no UsdValidation")
        yield from (f"CompositionError: {error}" for error in stage.GetCompositionErrors())
        return
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    if not whole:
        validators = [
            validator for validator in validators if validator.GetMetadata().name not in _OPEN_EVERYTHING
        ]
    try:
        errors = UsdValidation.ValidationContext(validators).Validate(stage)
    except Tf.ErrorException as error:
        # Validators run beside each other, and which error comes first is chance; the stage names the file.
        reasons = [str(fault) for fault in stage.GetCompositionErrors()] or [explain_usd_error(error)]
        expected = "expected files that USD can open, found one that it depends on broken"
        yield from (f"{expected}: {' '.join(text.split())}" for text in reasons)
        return
    for error in errors:
        yield f"{error.GetName()}: {error.GetMessage()}"


def _select_each_lod(stage: Usd.Stage) -> Iterator[str]:
    """Select every level of detail in turn, in the session only, and yield a text that names it."""
    root = stage.GetDefaultPrim()
    levels = root.GetVariantSet("lod").GetVariantNames() if root else []
    if not levels:
        yield ""
        return
    default = root.GetVariantSet("lod").GetVariantSelection()
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        # The default first: it was composed when the stage was opened.
        for level in sorted(levels, key=lambda name: name != default):
            root.GetVariantSet("lod").SetVariantSelection(level)
            yield f" (lod {level})"


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
        yield from id_faults(prim.GetIdsAttr().Get(time), count, at)
        orientations = prim.GetOrientationsfAttr().Get(time) if _has_float_orientations(prim) else None
        orientations = orientations or prim.GetOrientationsAttr().Get(time)
        scales = as_array(prim.GetScalesAttr().Get(time))
        fields = ParticleFields(
            positions=as_array(prim.GetPositionsAttr().Get(time)),
            rotations=as_wxyz(orientations),
            scales=scales if scales is None or sigmas is None else scales / np.float32(sigmas),
            extent=as_array(prim.GetExtentAttr().Get(time)),
        )
        yield from field_faults(fields, count, at, gaussians=sigmas is not None)
        yield from length_faults({"velocities": prim.GetVelocitiesAttr().Get(time)}, count, at)
        yield from display_faults(prim.GetPrim(), time, count, at)


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
        fields = ParticleFields(
            positions=as_array(value("Positions", time)),
            rotations=as_wxyz(value("Orientations", time)),
            scales=as_array(value("Scales", time)),
            extent=as_array(prim.GetExtentAttr().Get(time)),
        )
        yield from field_faults(fields, count, at, gaussians=True)
        opacities = as_array(value("Opacities", time))
        harmonics = as_array(value("RadianceSphericalHarmonicsCoefficients", time))
        yield from length_faults({"opacities": opacities}, count, at)
        yield from length_faults({"harmonics": harmonics}, count * (degree + 1) ** 2, at)
        yield from finite_faults({"opacities": opacities, "harmonics": harmonics}, at)
        if opacities is not None and len(opacities) and not 0 <= opacities.min() <= opacities.max() <= 1:
            yield f"{at}: expected opacities from 0 to 1, found {opacities.min():g} to {opacities.max():g}"
        yield from display_faults(prim.GetPrim(), time, count, at)


def _at(where: str, time: Usd.TimeCode) -> str:
    return where if time.IsDefault() else f"{where} at {time.GetValue():g}"


def _times(prim: Usd.Prim, frames: Sequence[int] | None) -> Sequence[Usd.TimeCode]:
    """Return the times to check: some frames, those of any sample, or the default."""
    # The samples of value clips are asked for only if need be: that opens every clip.
    times = frames
    if times is None:
        times = sorted(
            {time for attribute in prim.GetAuthoredAttributes() for time in attribute.GetTimeSamples()}
        )
    return [Usd.TimeCode(time) for time in times] or [Usd.TimeCode.Default()]


def _has_float_orientations(prim: UsdGeom.PointInstancer) -> bool:
    return hasattr(prim, "GetOrientationsfAttr") and prim.GetOrientationsfAttr().HasAuthoredValue()
