"""Splat files: 3DGS PLY, PlayCanvas's compressed PLY, SPZ and glTF, one file a frame or one frame."""

from dsar_exporters.splats.compact import CompressedPlySequence, SpzSequence
from dsar_exporters.splats.gltf import GltfSnapshot
from dsar_exporters.splats.ply import PlySequence, write_ply
from dsar_exporters.splats.reading import read_ply, read_splats

__all__ = [
    "CompressedPlySequence",
    "GltfSnapshot",
    "PlySequence",
    "SpzSequence",
    "read_ply",
    "read_splats",
    "write_ply",
]
