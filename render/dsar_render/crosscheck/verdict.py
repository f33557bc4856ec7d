"""What the cross-check says, and what of it is wrong."""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import UInt8

from dsar_render.crosscheck.points import Residuals
from dsar_render.crosscheck.proxies import Agreement
from dsar_render.crosscheck.splats import Explanation

Image = UInt8[np.ndarray, "h w 3"]

_LEAST_IOU, _MOST_DEPTH_M = 0.99, 1e-3
_MOST_COVERAGE = 0.005
_MOST_OF_OURS, _MOST_OF_THEIRS = 1e-3, 1e-2
"""Mean absolute difference of colours from a renderer's definition; Mitsuba's ellipsoids are meshes."""
_LEAST_CORRELATION = 0.95


@dataclass(frozen=True)
class CameraVerdict:
    """One camera, seen by both."""

    name: str
    residuals: Mapping[str, Residuals]
    """By whose projection: `ours`, and those of files."""
    mistakes: Mapping[str, str]
    """Of the projections that are wrong: which usual mistake explains it, `unknown` where none does."""
    proxy: Agreement

    @property
    def sees_proxy(self) -> bool:
        """Whether there is anything of the proxy geometry to compare."""
        return not math.isnan(self.proxy.iou)

    @property
    def faults(self) -> list[str]:
        """What is wrong with the proxy geometry. What is not a number is wrong."""
        proxy = self.proxy
        same = proxy.iou >= _LEAST_IOU and proxy.depth_mae <= _MOST_DEPTH_M and proxy.shapes >= _LEAST_IOU
        if same or not self.sees_proxy:
            return []
        return [
            f"{self.name}: proxy geometry differs: IoU {proxy.iou:.3f}, depths by "
            f"{1e3 * proxy.depth_mae:.1f} mm, shapes in {1 - proxy.shapes:.1%} of the pixels"
        ]


@dataclass(frozen=True)
class SplatVerdict:
    """The Gaussians themselves, seen by both, some pixels large."""

    psnr: float
    """Decibels of colours, the worst of some views; order and limits differ, so it is not judged."""
    coverage: float
    """Mean absolute difference of the coverage up to .99, where Mitsuba stops; the worst of some views."""
    explanations: Mapping[str, Explanation]
    """By camera, of the middle of the view."""
    gradients: Mapping[str, tuple[float, float]]
    """By field: correlation of our gradients and Mitsuba's, and how much larger its are."""

    @property
    def faults(self) -> list[str]:
        """What is wrong. What is not a number is wrong."""
        faults = []
        if not self.coverage <= _MOST_COVERAGE:
            faults.append(f"splats cover {self.coverage:.2%} of the image otherwise")
        for camera, explanation in self.explanations.items():
            if not explanation.ours <= _MOST_OF_OURS:
                faults.append(f"{camera}: our splats are {explanation.ours:.4f} from their definition")
            if not explanation.theirs <= _MOST_OF_THEIRS:
                faults.append(f"{camera}: splats differ by {explanation.theirs:.4f} that nothing explains")
        for name, (correlation, _) in self.gradients.items():
            if not correlation >= _LEAST_CORRELATION:
                faults.append(f"gradients by {name} correlate by {correlation:.2f} only")
        return faults


@dataclass(frozen=True)
class Verdict:
    """Everything that was found."""

    variant: str
    """Of Mitsuba."""
    cameras: tuple[CameraVerdict, ...]
    seeds: Mapping[str, str | None]
    """What a mistake that was made on purpose was taken for: its own name where it was caught."""
    splats: SplatVerdict | None
    skipped: Mapping[str, str]
    """What was not checked, and why."""
    pictures: Mapping[str, Sequence[Image]] = field(default_factory=dict)
    """Rows of images for the report: ours, Mitsuba's, the difference."""

    @property
    def passed(self) -> bool:
        """Whether nothing is wrong, as far as it was checked, and every seeded mistake was caught."""
        return not self.faults and self.caught == list(self.seeds)

    @property
    def faults(self) -> list[str]:
        """What is wrong, a line each."""
        faults = [
            f"{camera.name}, {source}: {fault}"
            for camera in self.cameras
            for source, fault in camera.mistakes.items()
        ]
        faults += [fault for camera in self.cameras for fault in camera.faults]
        if not any(camera.sees_proxy for camera in self.cameras):
            faults.append("no camera sees the body, so no silhouette and no depth was compared")
        return faults + (self.splats.faults if self.splats else [])

    @property
    def caught(self) -> list[str]:
        """The seeded mistakes that were found and named."""
        return [name for name, diagnosis in self.seeds.items() if diagnosis == name]

    @property
    def figures(self) -> "Figures":
        """The figures, as `dsar crosscheck --json` writes them."""
        residuals = [value for camera in self.cameras for value in camera.residuals.values()]
        return Figures(
            camera_px_rms=max(value.rms for value in residuals),
            camera_px_max=max(value.max for value in residuals),
            silhouette_iou=min(_numbers(camera.proxy.iou for camera in self.cameras)),
            depth_mae_m=max(_numbers(camera.proxy.depth_mae for camera in self.cameras)),
            splat_psnr=self.splats.psnr if self.splats else None,
            seeded_wrong_cameras_caught=self.caught,
            passed=self.passed,
            variant=self.variant,
            cameras={camera.name: camera for camera in self.cameras},
            seeds=dict(self.seeds),
            splats=self.splats,
            faults=self.faults,
            skipped=dict(self.skipped),
        )


@dataclass(frozen=True)
class Figures:
    """What `dsar crosscheck --json` writes: names and order of its keys."""

    camera_px_rms: float
    """Of all projections of the worst camera, pixels."""
    camera_px_max: float
    silhouette_iou: float
    depth_mae_m: float
    splat_psnr: float | None
    seeded_wrong_cameras_caught: list[str]
    passed: bool
    variant: str
    cameras: dict[str, CameraVerdict]
    seeds: dict[str, str | None]
    splats: SplatVerdict | None
    faults: list[str]
    skipped: dict[str, str]

    def to_json(self) -> dict[str, Any]:
        """Return the figures; null where something was not checked, with the reason under `skipped`."""
        return _without_infinities(dataclasses.asdict(self))


def _numbers(values: Iterable[float]) -> list[float]:
    """Return the values that are numbers; if none is, one that is not."""
    return [value for value in values if not math.isnan(value)] or [math.nan]


def _without_infinities(value: Any) -> Any:
    """Return the same with null for what is not finite, which JSON has no word for."""
    if isinstance(value, dict):
        return {key: _without_infinities(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_infinities(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
