"""The check of a whole capture: every image is read, and body and masks are compared."""

import statistics
import time
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np
import torch

from dsar.data.captures.multiview import MultiViewCapture
from dsar.data.motions.kinematics import JointTrajectories, trace_joints
from dsar.data.motions.mmd import FAR, NEAR, PoseDistribution
from dsar.errors import CaptureError
from dsar.evaluation.check.agreement_findings import find_fine_faults, find_gross_faults
from dsar.evaluation.check.finding import Finding
from dsar.evaluation.check.image_findings import find_color_faults, find_mask_faults
from dsar.evaluation.check.image_summaries import (
    ImageSummary,
    count_duplicates,
    count_images,
    count_jumps,
    histogram,
    summarize_images,
)
from dsar.evaluation.check.silhouettes import FINE, Mask, SilhouetteAgreement, compare, load_masks, read
from dsar.evaluation.check.verdict import CameraAgreement, CaptureFigures, CaptureVerdict, MotionDistance
from dsar.types import Motion

_FINE_CAMERAS = 8
"""Cameras whose masks are looked at in full size, at most."""
_LISTED = 5
Reporter = Callable[[str, float], None]
"""Is told what is being done, and the share of it that is done."""


def check_capture(capture: MultiViewCapture, report: Reporter = lambda *_: None) -> CaptureVerdict:
    """Read all of a capture and return what is wrong with it.

    Raises:
        CaptureError: no image at all can be read.
    """
    joints = {name: trace_joints(capture.body, motion) for name, motion in capture.motions.items()}
    total, summaries, began = count_images(capture), [], time.monotonic()
    for summary in summarize_images(capture):
        summaries.append(summary)
        report("read images", 0.8 * len(summaries) / max(total, 1))
    readable = [summary for summary in summaries if summary.broken is None]
    if not readable:
        raise CaptureError(
            f"capture {capture.name}: none of its {total} images can be read; the first: "
            f"{summaries[0].broken}"
        )
    read_ms = 1e3 * (time.monotonic() - began) / total
    duplicates = count_duplicates(joints, summaries)
    findings = _image_findings(capture, summaries, duplicates)
    figures = _measure(capture, joints, duplicates, read_ms)
    report("compare body and masks", 0.8)
    usable = {(p.sequence, p.frame, p.camera) for p in readable if p.coverage > 0 and not p.full}
    findings += find_color_faults(capture, readable, usable)
    findings += _gap_findings(capture, {(summary.sequence, summary.frame) for summary in readable})
    masks, hypothesis = load_masks(capture, usable), read(capture)
    agreements = list(compare(hypothesis, masks))
    if masks and not any(finding.name == "masks_inverted" for finding in findings):
        findings += find_gross_faults(capture, hypothesis, masks, agreements)
        report("look for fine mistakes", 0.95)
        if not any(finding.fatal for finding in findings):
            fine_cameras = min(_FINE_CAMERAS, len(capture.cameras))
            findings += find_fine_faults(capture, hypothesis, load_masks(capture, usable, FINE, fine_cameras))
    # In other units every step is a jump.
    if not any(finding.name.startswith("motion_in") for finding in findings):
        findings += [
            Finding("jumps", f"sequence {name}: the body jumps at frame {_list(frames)}; cut it there")
            for name, frames in count_jumps(capture.body, joints).items()
        ]
    return CaptureVerdict(_by_camera(capture, masks, agreements, summaries), findings, figures)


def _gap_findings(capture: MultiViewCapture, seen: Collection[tuple[str, int]]) -> list[Finding]:
    """Return which sequences have frames that no camera saw."""
    findings = []
    for name, motion in _filmed(capture).items():
        unseen = [frame for frame in range(len(motion)) if (name, frame) not in seen]
        if unseen:
            what = f"sequence {name}: no camera has an image of {len(unseen)} of {len(motion)} frames: "
            advice = "; they are done without; if they are many, do motion and images belong together?"
            everything = len(unseen) == len(motion)
            findings.append(Finding("unseen_frames", what + _list(unseen) + advice, everything))
    return findings


def _filmed(capture: MultiViewCapture) -> dict[str, Motion]:
    """Return the motions of which there should be images: all but the unseen ones."""
    return {name: motion for name, motion in capture.motions.items() if name in capture.views}


def _image_findings(
    capture: MultiViewCapture, summaries: Sequence[ImageSummary], duplicates: Mapping[int, int]
) -> list[Finding]:
    findings = []
    broken = [summary.broken for summary in summaries if summary.broken is not None]
    if broken:
        what = f"{len(broken)} images cannot be used; the first: {broken[0]}"
        findings.append(Finding("broken_images", what, True))
    findings += find_mask_faults(capture, [summary for summary in summaries if summary.broken is None])
    for camera, count in sorted(duplicates.items()):
        findings.append(
            Finding(
                "duplicate_frames",
                f"{capture.cameras[camera].name}: {count} images equal the one before though the body moved: "
                "the recording stuttered, or frames were filled in; delete them, they are done without",
            )
        )
    return findings


def _measure(
    capture: MultiViewCapture,
    joints: Mapping[str, JointTrajectories],
    duplicates: Mapping[int, int],
    read_ms: float,
) -> CaptureFigures:
    """Return what is known of motion and files without comparing them."""
    speeds = torch.cat([trajectories.speeds for trajectories in joints.values()])
    percentiles = np.percentile(speeds.numpy(), [50, 95, 99.9]) if len(speeds) else [0.0] * 3
    return CaptureFigures(
        read_ms=read_ms,
        frames={name: len(motion) for name, motion in capture.motions.items()},
        fps=capture.fps,
        splits={split: list(names) for split, names in capture.splits.items()},
        divergence=_motion_distances(capture),
        fastest_joint_m_s=dict(zip(("p50", "p95", "p99.9"), map(float, percentiles), strict=True)),
        fastest_joint_histogram=histogram(speeds),
        duplicates={capture.cameras[k].name: count for k, count in duplicates.items()},
        disk_bytes=sum(path.stat().st_size for path in capture.root.rglob("*") if path.is_file()),
    )


def _motion_distances(capture: MultiViewCapture) -> dict[str, MotionDistance]:
    """Return how far the test sequences of at least two frames are from training."""
    tests = [name for name in capture.splits["test"] if len(capture.motions[name]) > 1]
    if not tests:
        return {}
    training = PoseDistribution.from_motions(capture.motions[name] for name in capture.splits["train"])
    distances = {}
    for name in tests:
        mmd = training.mmd([capture.motions[name]])
        label = "near" if mmd < NEAR else "far" if mmd > FAR else "between"
        distances[name] = MotionDistance(mmd, mmd**2, label)
    return distances


def _by_camera(
    capture: MultiViewCapture,
    masks: Sequence[Mask],
    agreements: Sequence[SilhouetteAgreement],
    summaries: Sequence[ImageSummary],
) -> list[CameraAgreement]:
    frames, verdicts = sum(map(len, _filmed(capture).values())), []
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
