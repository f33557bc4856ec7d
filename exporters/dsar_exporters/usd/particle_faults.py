"""What must be true of the arrays of a USD prim with Gaussians or other particles, at one time.

Imports pxr.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom

from dsar_exporters.usd.particle_frame import EXTENT_SIGMAS, axis_extents

_LENGTH_TOLERANCE = 4e-3
"""How far a quaternion's length may be from 1: the rounding of 16 bits."""
_EXTENT_TOLERANCE_M = 1e-4
"""Metres that a Gaussian may reach beyond its extent: rounding."""


@dataclass(frozen=True)
class ParticleFields:
    """Values of a prim at one time, as arrays; None where it has none."""

    positions: np.ndarray | None
    rotations: np.ndarray | None
    """wxyz."""
    scales: np.ndarray | None
    """Standard deviations."""
    extent: np.ndarray | None


def field_faults(fields: ParticleFields, count: int, at: str, *, gaussians: bool) -> Iterator[str]:
    """Yield what is wrong with positions, rotations, scales and extent at one time."""
    named = {"positions": fields.positions, "orientations": fields.rotations, "scales": fields.scales}
    needed = named if gaussians else ("positions",)
    missing = [name for name in needed if named[name] is None]
    if missing:
        yield f"{at}: expected {', '.join(missing)}, found none"
        return
    faults = [*length_faults(named, count, at), *finite_faults(named, at)]
    yield from faults
    if faults or not count:
        return
    if fields.rotations is not None:
        lengths = np.linalg.norm(fields.rotations, axis=1)
        if np.abs(lengths - 1).max() > _LENGTH_TOLERANCE:
            yield f"{at}: expected unit quaternions, found lengths {lengths.min():g} to {lengths.max():g}"
    if fields.extent is None:
        yield f"{at}: expected an extent, found none: applications could not frame or cull it"
    elif fields.extent.shape != (2, 3) or not np.isfinite(fields.extent).all():
        yield f"{at}: expected an extent of two finite corners, found {fields.extent.tolist()}"
    elif gaussians:
        yield from _extent_faults(fields, at)


def _extent_faults(fields: ParticleFields, at: str) -> Iterator[str]:
    """Yield what is wrong with the size of Gaussians, and with the extent that must hold them."""
    assert fields.positions is not None
    assert fields.rotations is not None
    assert fields.scales is not None
    if fields.scales.min() <= 0:
        yield f"{at}: expected scales above 0, found {fields.scales.min():g}"
    if fields.extent is None:
        return
    rotations = fields.rotations / np.linalg.norm(fields.rotations, axis=1, keepdims=True)
    extents = axis_extents(rotations, fields.scales)
    low, high = (fields.positions - extents).min(0), (fields.positions + extents).max(0)
    slack = _EXTENT_TOLERANCE_M + 2e-3 * float(fields.scales.max())
    if (fields.extent[0] > low + slack).any() or (fields.extent[1] < high - slack).any():
        yield (
            f"{at}: expected an extent that holds {EXTENT_SIGMAS:g} standard deviations, "
            f"{[low.tolist(), high.tolist()]}, found {fields.extent.tolist()}"
        )


def display_faults(prim: Usd.Prim, time: Usd.TimeCode, count: int, at: str) -> Iterator[str]:
    """Yield what is wrong with the primvars that applications draw with."""
    primvars = UsdGeom.PrimvarsAPI(prim)
    for name in ("displayColor", "displayOpacity", "id", "velocities"):
        primvar = primvars.GetPrimvar(name)
        if primvar and primvar.GetInterpolation() == UsdGeom.Tokens.vertex:
            yield from length_faults({f"primvars:{name}": primvar.Get(time)}, count, at)


def length_faults(named: dict[str, Any], count: int, at: str) -> Iterator[str]:
    """Yield which arrays have another length than there are particles."""
    for name, values in named.items():
        if values is not None and len(values) != count:
            yield f"{at}: expected {count} {name}, found {len(values)}"


def finite_faults(named: dict[str, np.ndarray | None], at: str) -> Iterator[str]:
    """Yield which arrays hold values that are not finite."""
    for name, values in named.items():
        broken = 0 if values is None else int((~np.isfinite(values)).sum())
        if broken:
            yield f"{at}: expected finite {name}, found {broken} values that are not"


def id_faults(ids: Any, count: int, where: str) -> Iterator[str]:
    """Yield what is wrong with ids: their number, or one that stands twice."""
    if ids is None:
        return
    if len(ids) != count:
        yield f"{where}: expected {count} ids, found {len(ids)}"
    elif len(set(ids)) != count:
        yield f"{where}: expected each id once, found {count - len(set(ids))} again"


def as_array(value: Any) -> np.ndarray | None:
    """Return values as an array, None for None."""
    return None if value is None else np.array(value, np.float32)


def as_wxyz(value: Any) -> np.ndarray | None:
    """Return quaternions as an array; Vt's buffers hold them xyzw."""
    return None if value is None else np.array(value, np.float32).reshape(-1, 4)[:, [3, 0, 1, 2]]
