"""What `dsar check` says of a capture."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dsar.evaluation.check.finding import Finding


@dataclass(frozen=True)
class CameraAgreement:
    """How one camera's images agree with the body."""

    name: str
    images: int
    """How many there are."""
    missing: int
    """How many there are not."""
    inside: float | None
    """Mean share of the body's silhouette in the mask; None without images."""
    iou: float | None
    """Mean intersection over union: below 1 also where clothes stand off."""


@dataclass(frozen=True)
class MotionDistance:
    """How far a test sequence's poses are from those of training."""

    mmd: float
    """Maximum mean discrepancy."""
    mmd_squared: float
    label: str
    """`near`, `far` or `between`, by the paper's limits."""


@dataclass(frozen=True)
class CaptureFigures:
    """What is known of a capture's motion and files; the fields are the keys in JSON."""

    read_ms: float
    """Milliseconds in which an image is read."""
    frames: Mapping[str, int]
    """By sequence."""
    fps: float
    """Frames per second."""
    splits: Mapping[str, Sequence[str]]
    """Names of sequences."""
    divergence: Mapping[str, MotionDistance]
    """By test sequence."""
    fastest_joint_m_s: Mapping[str, float]
    """Percentiles of the fastest joint's speed, metres a second."""
    fastest_joint_histogram: Mapping[str, int]
    """Frames by that speed, metres a second."""
    duplicates: Mapping[str, int]
    """Images by camera that equal the one before though the body moved."""
    disk_bytes: int


@dataclass(frozen=True)
class CaptureVerdict:
    """What `dsar check` found."""

    cameras: Sequence[CameraAgreement]
    findings: Sequence[Finding]
    figures: CaptureFigures

    @property
    def fatal(self) -> bool:
        """Whether the capture cannot train."""
        return any(finding.fatal for finding in self.findings)

    def to_json(self) -> dict[str, Any]:
        """Return everything in JSON's types."""
        return {**dataclasses.asdict(self), "fatal": self.fatal}
