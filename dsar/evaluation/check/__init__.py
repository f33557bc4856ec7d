"""`dsar check`: whether a capture can train an avatar, what is wrong with it and how to mend it."""

from dsar.evaluation.check.capture_check import check_capture
from dsar.evaluation.check.finding import Finding
from dsar.evaluation.check.overlay import draw_overlays
from dsar.evaluation.check.quick_check import refuse_unusable_images
from dsar.evaluation.check.verdict import CameraAgreement, CaptureVerdict

__all__ = [
    "CameraAgreement",
    "CaptureVerdict",
    "Finding",
    "check_capture",
    "draw_overlays",
    "refuse_unusable_images",
]
