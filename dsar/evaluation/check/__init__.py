"""`dsar check`: whether a capture can train an avatar, what is wrong with it and how to mend it."""

from dsar.evaluation.check.finding import Finding
from dsar.evaluation.check.glance import refuse_at_a_glance
from dsar.evaluation.check.overlay import draw_overlays
from dsar.evaluation.check.verdict import CameraVerdict, Verdict, check_capture

__all__ = ["CameraVerdict", "Finding", "Verdict", "check_capture", "draw_overlays", "refuse_at_a_glance"]
