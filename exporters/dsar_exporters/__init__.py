"""Delivery: a rollout or an image in the formats of film and game pipelines.

Each writer takes a `GaussianSequence` or a `RenderOutput` and nothing else; formats' own libraries are
imported when a writer runs, never before. Frame numbers are the same in every format.
"""

from dsar_exporters.exr import exr_path, write_exr
from dsar_exporters.frames import parse_frames
from dsar_exporters.ply import read_ply, write_ply
from dsar_exporters.usd import write_usd

__all__ = ["exr_path", "parse_frames", "read_ply", "write_exr", "write_ply", "write_usd"]
