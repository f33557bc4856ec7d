"""What is wrong with a capture by how its masks agree with its body."""

import dataclasses
import statistics
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from torch import Tensor

from dsar.body.files import load_hands
from dsar.data.captures.multiview import MultiViewCapture
from dsar.errors import BodyError
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
from dsar.evaluation.check.silhouettes import (
    Hypothesis,
    Mask,
    SilhouetteAgreement,
    crop_to_hands,
    silhouette_errors,
)

APART = 0.5
"""Share of the body in the masks below which a capture cannot train."""
POOR = 0.9
"""And below which something is likely wrong."""
_GROSS = 0.1
"""Error by which a mistake may not be outdone if the capture is to train."""
_UNUSUAL = (1.3, 0.03)
"""How many times the median camera's error one must have to be suspect, and how much more."""
_EXPLAINED = 0.5
"""Share of an error below which its cause is found."""
_LATEST = 5
"""Frames by which a camera may be late, at most, to be told so."""


def find_gross_faults(
    capture: MultiViewCapture,
    hypothesis: Hypothesis,
    masks: Sequence[Mask],
    agreements: Sequence[SilhouetteAgreement],
) -> list[Finding]:
    """Return what body and masks say of cameras, motion and numbering."""
    inside = statistics.fmean(each.inside for each in agreements)
    before = np.array([each.error for each in agreements])
    candidate = find_fault(hypothesis, masks, coarse_faults(capture.R_world_file), before)
    apart = inside < APART
    # A body that is drawn too small lies in the mask, and is as wrong as one beside it.
    gross = (
        candidate is not None and not candidate.fault.shift and candidate.before - candidate.after > _GROSS
    )
    findings = [_candidate_finding(candidate, apart or gross)] if candidate else []
    if candidate is None or candidate.fault.name.startswith("frame_offset"):
        findings += _find_odd_cameras(capture, hypothesis, masks, before)
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


def _find_odd_cameras(
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


def find_fine_faults(
    capture: MultiViewCapture, hypothesis: Hypothesis, masks: Sequence[Mask]
) -> list[Finding]:
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
