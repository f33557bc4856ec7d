"""Which prims of a stage are cameras, and how they are called.

Imports pxr: only `dsar_exporters.usd` imports this module, when it reads.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

import re
from collections.abc import Sequence
from pathlib import Path

from pxr import Usd, UsdGeom

from dsar.errors import ExportError
from dsar_exporters.usd.stages import open_stage

_OBJECT_NAME = "userProperties:blender:object_name"
"""Blender writes its object as an Xform and the object's data as a prim within."""


def find_cameras(path: Path) -> tuple[Usd.Stage, dict[str, Usd.Prim]]:
    """Return a stage, which prims do not keep open, and its cameras in order by the names we give them.

    Raises:
        ExportError: It is no USD file or has no camera.
    """
    if not path.is_file():
        raise ExportError(f"{path}: expected a USD file with cameras, found none: give its path")
    stage = open_stage(path)
    _retype_merged_cameras(stage)
    all_prims = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
    prims = [prim for prim in all_prims if prim.IsA(UsdGeom.Camera)]
    if not prims:
        raise ExportError(f"{path}: expected cameras, found none: export them too, or name another file")
    return stage, dict(zip(name_cameras(prims), prims, strict=True))


def _retype_merged_cameras(stage: Usd.Stage) -> None:
    """Make cameras, in memory, of those that Blender calls transforms.

    With "Merge parent Xform", Blender 4.5 defines a camera that moves again as an Xform, after its lens.
    """
    merged = [
        prim
        for prim in stage.Traverse()
        if prim.GetTypeName() == "Xform" and prim.HasAttribute(UsdGeom.Tokens.horizontalAperture)
    ]
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for prim in merged:
            prim.SetTypeName("Camera")


def with_ancestors(prim: Usd.Prim) -> list[Usd.Prim]:
    """Return a prim and those above it, from the prim up."""
    chain = [prim]
    while (parent := chain[-1].GetParent()) and not parent.IsPseudoRoot():
        chain.append(parent)
    return chain


def name_cameras(prims: Sequence[Usd.Prim]) -> list[str]:
    """Return names that differ and are identifiers: of the objects, led by parents' where those are equal."""
    chains = [[ancestor.GetName() for ancestor in with_ancestors(_named_prim(prim))] for prim in prims]
    lengths = [1] * len(prims)
    while True:
        names = [
            _identifier("_".join(reversed(chain[:length])))
            for chain, length in zip(chains, lengths, strict=True)
        ]
        longer = [
            length + (names.count(name) > 1 and length < len(chain))
            for name, chain, length in zip(names, chains, lengths, strict=True)
        ]
        if longer == lengths:
            return _number_duplicates(names)
        lengths = longer


def _number_duplicates(names: Sequence[str]) -> list[str]:
    """Return names with numbers where whole paths are one identifier, such as those of two shapes."""
    result: list[str] = []
    for name in names:
        number, unique = 1, name
        while unique in result:
            number += 1
            unique = f"{name}_{number}"
        result.append(unique)
    return result


def _named_prim(prim: Usd.Prim) -> Usd.Prim:
    """Return the prim whose name the camera's author knows.

    Blender and Maya write an object's transform and its data as two prims; then the data has no transform of
    its own, and its name is one that nobody chose.
    """
    parent = prim.GetParent()
    if not parent.IsA(UsdGeom.Xform) or UsdGeom.Xformable(prim).GetXformOpOrderAttr().HasAuthoredValue():
        return prim
    cameras = [child for child in parent.GetChildren() if child.IsA(UsdGeom.Camera)]
    moved = UsdGeom.Xformable(parent).GetXformOpOrderAttr().HasAuthoredValue()
    return parent if len(cameras) == 1 and (moved or parent.HasAttribute(_OBJECT_NAME)) else prim


def _identifier(name: str) -> str:
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return f"cam_{plain}" if plain[0].isdigit() else plain
