"""Delivery: a rollout or an image in the formats of film and game pipelines.

Each writer takes a `GaussianSequence` or a `RenderOutput` and nothing else; formats' own libraries are
imported when a writer runs, never before. Frame numbers are the same in every format. `export` writes any
mix of formats from one rollout.
"""

from dsar_exporters.delivery import Delivery, Output, export
from dsar_exporters.exr import ColorTarget, ExrSequence, exr_path, ocio_config, write_exr
from dsar_exporters.inspection import find_faults
from dsar_exporters.projections import read_back_projections
from dsar_exporters.splats import (
    CompressedPlySequence,
    GltfSnapshot,
    PlySequence,
    SpzSequence,
    read_ply,
    read_splats,
    write_ply,
)
from dsar_exporters.usd import UsdAsset, list_usd_cameras, read_usd_cameras, write_usd

__all__ = [
    "ColorTarget",
    "CompressedPlySequence",
    "Delivery",
    "ExrSequence",
    "GltfSnapshot",
    "Output",
    "PlySequence",
    "SpzSequence",
    "UsdAsset",
    "export",
    "exr_path",
    "find_faults",
    "list_usd_cameras",
    "ocio_config",
    "read_back_projections",
    "read_ply",
    "read_splats",
    "read_usd_cameras",
    "write_exr",
    "write_ply",
    "write_usd",
]
