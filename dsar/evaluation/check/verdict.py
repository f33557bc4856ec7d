"""The verdict on a capture: what was measured, what is wrong, what to do."""

import dataclasses
import statistics
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.body.files import load_hands
from dsar.data.captures.multiview import MultiViewCapture
from dsar.data.motions.mmd import FAR, NEAR, motion_mmd
from dsar.data.motions.out_of_distribution import joint_speeds
from dsar.errors import BodyError, CaptureError
from dsar.evaluation.check import image_summaries
from dsar.evaluation.check.faults import (
    Candidate,
    coarse_faults,
    control_hypotheses,
    find_fault,
    half_pixel_faults,
    hand_faults,
    is_significantly_smaller,
)
from dsar.evaluation.check.finding import Finding
from dsar.evaluation.check.image_findings import find_color_faults, find_mask_faults
from dsar.evaluation.check.silhouettes import (
    FINE,
    Hypothesis,
    Mask,
    SilhouetteAgreement,
    compare,
    crop_to_hands,
    load_masks,
    read,
    silhouette_errors,
)

APART = 0.5
"""Share of the body in the masks below which a capture cannot train."""
POOR = 0.9
"""And below which something is likely wrong."""
_GROSS = 0.1
"""Error by which a mistake may not be outdone if the capture is to train."""
_FINE_CAMERAS = 8
_UNUSUAL = (1.3, 0.03)
"""How many times the median camera's error one must have to be suspect, and how much more."""
_EXPLAINED = 0.5
"""Share of an error below which its cause is found."""
_LATEST = 5
_LISTED = 5
Reporter = Callable[[str, float], None]
"""Is told what is being done, and the share of it that is done."""


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
class CaptureVerdict:
    """What `dsar check` found."""

    cameras: Sequence[CameraAgreement]
    findings: Sequence[Finding]
    figures: Mapping[str, Any] = field(default_factory=dict)
    """Speeds, duplicates, divergence of the test sequences, sizes."""

    @property
    def fatal(self) -> bool:
        """Whether the capture cannot train."""
        return any(finding.fatal for finding in self.findings)

    def to_json(self) -> dict[str, Any]:
        """Return everything in JSON's types."""
        return {**dataclasses.asdict(self), "fatal": self.fatal}


def check_capture(capture: MultiViewCapture, report: Reporter = lambda *_: None) -> CaptureVerdict:
    """Read all of a capture and return what is wrong with it.

    Raises:
        CaptureError: no image at all can be read.
    """
    findings, figures = [], {}
    total, summaries, began = image_summaries.count_images(capture), [], time.monotonic()
    for summary in image_summaries.summarize_images(capture):
        summaries.append(summary)
        report("read images", 0.8 * len(summaries) / max(total, 1))
    readable = [summary for summary in summaries if summary.broken is None]
    if not readable:
        raise CaptureError(
            f"capture {capture.name}: none of its {total} images can be read; the first: "
            f"{summaries[0].broken}"
        )
    findings += _image_findings(capture, summaries)
    figures["read_ms"] = 1e3 * (time.monotonic() - began) / total
    figures |= _describe(capture, summaries)
    report("compare body and masks", 0.8)
    usable = {(p.sequence, p.frame, p.camera) for p in readable if p.coverage > 0 and not p.full}
    findings += find_color_faults(capture, readable, usable)
    findings += _gap_findings(capture, {(summary.sequence, summary.frame) for summary in readable})
    masks, hypothesis = load_masks(capture, usable), read(capture)
    agreements = list(compare(hypothesis, masks))
    if masks and not any(finding.name == "masks_inverted" for finding in findings):
        findings += _agreement_findings(capture, hypothesis, masks, agreements)
        report("look for fine mistakes", 0.95)
        if not any(finding.fatal for finding in findings):
            some = min(_FINE_CAMERAS, len(capture.cameras))
            findings += _fine_findings(capture, hypothesis, load_masks(capture, usable, FINE, some))
    # In other units every step is a jump.
    if not any(finding.name.startswith("motion_in") for finding in findings):
        findings += [
            Finding("jumps", f"sequence {name}: the body jumps at frame {_list(frames)}; cut it there")
            for name, frames in image_summaries.count_jumps(capture).items()
        ]
    return CaptureVerdict(_by_camera(capture, masks, agreements, summaries), findings, figures)


def _gap_findings(capture: MultiViewCapture, seen: Collection[tuple[str, int]]) -> list[Finding]:
    """Return which sequences have frames that no camera saw."""
    findings = []
    for name, motion in capture.motions.items():
        unseen = [frame for frame in range(len(motion)) if (name, frame) not in seen]
        if unseen:
            what = f"sequence {name}: no camera has an image of {len(unseen)} of {len(motion)} frames: "
            advice = "; they are done without; if they are many, do motion and images belong together?"
            everything = len(unseen) == len(motion)
            findings.append(Finding("unseen_frames", what + _list(unseen) + advice, everything))
    return findings


def _image_findings(
    capture: MultiViewCapture, summaries: Sequence[image_summaries.ImageSummary]
) -> list[Finding]:
    findings = []
    broken = [summary.broken for summary in summaries if summary.broken is not None]
    if broken:
        what = f"{len(broken)} images cannot be used; the first: {broken[0]}"
        findings.append(Finding("broken_images", what, True))
    findings += find_mask_faults(capture, [summary for summary in summaries if summary.broken is None])
    for camera, count in sorted(image_summaries.count_duplicates(capture, summaries).items()):
        findings.append(
            Finding(
                "duplicate_frames",
                f"{capture.cameras[camera].name}: {count} images equal the one before though the body moved: "
                "the recording stuttered, or frames were filled in; delete them, they are done without",
            )
        )
    return findings


def _agreement_findings(
    capture: MultiViewCapture,
    hypothesis: Hypothesis,
    masks: Sequence[Mask],
    agreements: Sequence[SilhouetteAgreement],
) -> list[Finding]:
    """Return what body and masks say of cameras, motion and numbering."""
    inside = statistics.fmean(each.inside for each in agreements)
    before = np.array([each.error for each in agreements])
    candidate = find_fault(hypothesis, masks, coarse_faults(capture.turn), before)
    apart = inside < APART
    # A body that is drawn too small lies in the mask, and is as wrong as one beside it.
    gross = (
        candidate is not None and not candidate.fault.shift and candidate.before - candidate.after > _GROSS
    )
    findings = [_candidate_finding(candidate, apart or gross)] if candidate else []
    if candidate is None or candidate.fault.name.startswith("frame_offset"):
        findings += _camera_findings(capture, hypothesis, masks, before)
    if not findings and inside < POOR:
        what = f"only {inside:.0%} of the body is in the masks"
        findings.append(
            Finding(
                "body_apart",
                f"{what}, and no usual mistake explains it: look at the sheet; are body file, shape and "
                "calibration the right ones?",
                apart,
            )
        )
    return findings


def _camera_findings(
    capture: MultiViewCapture, hypothesis: Hypothesis, masks: Sequence[Mask], before: np.ndarray
) -> list[Finding]:
    """Return which cameras agree much less than the others, and whose images theirs are."""
    index = np.array([mask.camera for mask in masks])
    means = {int(camera): float(before[index == camera].mean()) for camera in np.unique(index)}
    usual = statistics.median(means.values())
    findings = []
    for camera, mean in means.items():
        if mean < _UNUSUAL[0] * usual or mean < usual + _UNUSUAL[1]:
            continue
        own = [mask for mask in masks if mask.camera == camera]
        late = {k: silhouette_errors(hypothesis, own, k).mean() for k in range(-_LATEST, _LATEST + 1)}
        others = {
            k: silhouette_errors(
                dataclasses.replace(hypothesis, cameras={camera: hypothesis.cameras[k]}), own
            ).mean()
            for k in hypothesis.cameras
            if k != camera
        }
        best = min(others, key=lambda k: others[k])
        shift = min(late, key=lambda k: late[k])
        name = capture.cameras[camera].name
        if others[best] < _EXPLAINED * mean and others[best] < late[shift]:
            what = f"the images of {name} are those of {capture.cameras[best].name}: exchange their folders"
            findings.append(Finding("cameras_swapped", what))
        elif shift and late[shift] - usual < _EXPLAINED * (mean - usual):
            how = f"{abs(shift)} frames {'ahead' if shift > 0 else 'late'}"
            findings.append(
                Finding("camera_late", f"the images of {name} are {how}: number them as the others")
            )
        else:
            what = f"{name} disagrees with the others: calibrate it anew, or leave it out"
            findings.append(Finding("camera_off", what))
    return findings


def _fine_findings(capture: MultiViewCapture, hypothesis: Hypothesis, masks: Sequence[Mask]) -> list[Finding]:
    """Return what shows at full resolution only."""
    candidates = []
    candidate = find_fault(hypothesis, masks, half_pixel_faults(), silhouette_errors(hypothesis, masks))
    if candidate is not None:
        # A fit that is a little off gains by a move in other directions too.
        after = silhouette_errors(candidate.fault.undo(hypothesis), masks)
        if all(
            is_significantly_smaller(silhouette_errors(other, masks), after)
            for other in control_hypotheses(hypothesis)
        ):
            candidates.append(candidate)
    hands = crop_to_hands(hypothesis, masks)
    if hands:
        faults = hand_faults(_mean_hands(capture))
        candidates.append(find_fault(hypothesis, hands, faults, silhouette_errors(hypothesis, hands)))
    return [_candidate_finding(candidate, fatal=False) for candidate in candidates if candidate is not None]


def _mean_hands(capture: MultiViewCapture) -> Float[Tensor, "2 45"] | None:
    try:
        return load_hands(capture.body_path)[1] if capture.body_path else None
    except BodyError:
        return None


def _candidate_finding(candidate: Candidate, fatal: bool) -> Finding:
    share = f"{candidate.before:.3f} to {candidate.after:.3f}"
    return Finding(candidate.fault.name, f"{candidate.fault.remedy} (the error falls from {share})", fatal)


def _describe(capture: MultiViewCapture, summaries: Sequence[image_summaries.ImageSummary]) -> dict[str, Any]:
    """Return what is known of motion and files without comparing them."""
    speeds = torch.cat([joint_speeds(capture.body, motion) for motion in capture.motions.values()])
    splits = capture.splits
    percentiles = np.percentile(speeds.numpy(), [50, 95, 99.9]) if len(speeds) else [0.0] * 3
    divergences = {}
    for name in splits["test"]:
        if len(capture.motions[name]) > 1:
            found = motion_mmd(capture.motions, splits["train"], [name])
            label = "near" if found < NEAR else "far" if found > FAR else "between"
            divergences[name] = {"mmd": found, "mmd_squared": found**2, "label": label}
    return {
        "frames": {name: len(motion) for name, motion in capture.motions.items()},
        "fps": capture.fps,
        "splits": {split: list(names) for split, names in splits.items()},
        "divergence": divergences,
        "fastest_joint_m_s": dict(zip(("p50", "p95", "p99.9"), map(float, percentiles), strict=True)),
        "fastest_joint_histogram": image_summaries.histogram(speeds),
        "duplicates": {
            capture.cameras[k].name: count
            for k, count in image_summaries.count_duplicates(capture, summaries).items()
        },
        "disk_bytes": sum(path.stat().st_size for path in capture.root.rglob("*") if path.is_file()),
    }


def _by_camera(
    capture: MultiViewCapture,
    masks: Sequence[Mask],
    agreements: Sequence[SilhouetteAgreement],
    summaries: Sequence[image_summaries.ImageSummary],
) -> list[CameraAgreement]:
    frames, verdicts = sum(map(len, capture.motions.values())), []
    for index, camera in enumerate(capture.cameras):
        own = [each for mask, each in zip(masks, agreements, strict=True) if mask.camera == index]
        count = sum(summary.camera == index for summary in summaries)
        verdicts.append(
            CameraAgreement(
                camera.name,
                count,
                frames - count,
                statistics.fmean(each.inside for each in own) if own else None,
                statistics.fmean(each.iou for each in own) if own else None,
            )
        )
    return verdicts


def _list(frames: Sequence[int]) -> str:
    more = f" and {len(frames) - _LISTED} more" if len(frames) > _LISTED else ""
    return ", ".join(map(str, frames[:_LISTED])) + more
