"""An independent renderer's opinion: Mitsuba against our cameras, depths, silhouettes and splats."""

from dsar_render.crosscheck.backend import load_mitsuba
from dsar_render.crosscheck.comparison import cross_check
from dsar_render.crosscheck.proxies import Shape, ellipsoids
from dsar_render.crosscheck.report import write_crosscheck_report
from dsar_render.crosscheck.verdict import Verdict

__all__ = ["Shape", "Verdict", "cross_check", "ellipsoids", "load_mitsuba", "write_crosscheck_report"]
