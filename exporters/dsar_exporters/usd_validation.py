"""The checks a written asset must pass before it is handed over.

Imports pxr: only `write_usd` imports this module.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

import logging
from pathlib import Path

from pxr import Usd, UsdGeom, UsdVol

from dsar.errors import ExportError
from dsar.types import GaussianSequence

_logger = logging.getLogger(__name__)


def validate_asset(path: Path, sequence: GaussianSequence, *, name: str) -> None:
    """Open a written asset and check it with USD's validators and against the sequence.

    Raises:
        ExportError: A validator reports an error, or an array's length differs from the number of Gaussians.
    """
    stage = Usd.Stage.Open(str(path))
    _run_validators(stage, path)
    for frame in (sequence.frame_numbers[0], sequence.frame_numbers[-1]):
        _check_lengths(stage, frame, sequence.num_gaussians, name)


def _run_validators(stage: Usd.Stage, path: Path) -> None:
    try:
        from pxr import UsdValidation
    except ImportError:
        _logger.warning("%s: not validated: this usd-core has no UsdValidation", path.name)
        return
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    problems = [f"{error.GetName()}: {error.GetMessage()}" for error in found]
    if problems:
        raise ExportError(
            f"{path.name}: USD's validators found {len(problems)} faults: {'; '.join(problems)}"
        )


def _check_lengths(stage: Usd.Stage, frame: int, count: int, name: str) -> None:
    """Check the lengths of all arrays, which no stock validator does."""
    instancer = UsdGeom.PointInstancer.Get(stage, f"/{name}/instancer")
    splats = UsdVol.ParticleField3DGaussianSplat.Get(stage, f"/{name}/splats")
    harmonics_count = (splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() + 1) ** 2
    expected = {
        instancer.GetPositionsAttr(): count,
        instancer.GetOrientationsAttr(): count,
        instancer.GetOrientationsfAttr(): count,
        instancer.GetScalesAttr(): count,
        instancer.GetVelocitiesAttr(): count,
        instancer.GetIdsAttr(): count,
        instancer.GetProtoIndicesAttr(): count,
        splats.GetPositionsAttr(): count,
        splats.GetOrientationsAttr(): count,
        splats.GetScalesAttr(): count,
        splats.GetOpacitiesAttr(): count,
        splats.GetRadianceSphericalHarmonicsCoefficientsAttr(): count * harmonics_count,
    }
    for attribute, length in expected.items():
        value = attribute.Get(frame)
        found = None if value is None else len(value)
        if found != length:
            raise ExportError(
                f"{attribute.GetPath()} at {frame}: expected {length} values, found {found}: this is a fault "
                "of the exporter, please report it"
            )
