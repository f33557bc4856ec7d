"""How well a garment moves on motions that nobody trained on: its points' error in mm, by motion and split.

Each motion is rolled out freely from a cold start, and where the avatar carries the true garment's points
(`garment_tracking`) is compared with the truth. Nothing is rendered. Beside the prediction stand the template
under skinning alone, and another true run of the same motion, which no method can be asked to beat.

`unseen_validation` is for choosing, `unseen_test` for reports alone.
"""

import statistics
from collections.abc import Collection, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.rollout import network_outputs
from dsar.data.captures.multiview import MultiViewCapture
from dsar.evaluation.garment_tracking import TrackedGarment, check_same_points, track_garment
from dsar.evaluation.results import UnseenFigures, UnseenMotion
from dsar.evaluation.stops import find_stops, measure_stop
from dsar.network import STREAMS, Stream

SPLITS = {"validation": "unseen_validation", "test": "unseen_test"}
"""Splits of a capture by their names among the figures."""
PINNED = 1e-3
"""Metres: points that two true runs of a motion never part by are held by the body, and left out."""
DRAWS = 2000
"""Resampled sets of motions behind an interval."""
_MILLIMETRES = 1000.0


def unseen_missing(avatar: Avatar, capture: MultiViewCapture) -> str | None:
    """Return why nothing can be said of unseen motions, or None."""
    if not any(capture.splits.get(split) for split in SPLITS.values()):
        return "no unseen motions in the capture"
    if not len(avatar.garment_texels()):
        return "no garment chart in the avatar"
    if not any(capture.garment_runs(name) for name in capture.splits["train"]):
        return "no garment truth in training sequences, to find its points by"
    return None


def measure_unseen(
    avatar: Avatar, capture: MultiViewCapture, streams: Collection[Stream] = STREAMS
) -> dict[str, UnseenFigures]:
    """Return the figures of a capture's unseen motions by split (`SPLITS`), of those that it has.

    Raises:
        CaptureError: see `measure_motions`.
    """
    return {
        name: summarize_motions(measure_motions(avatar, capture, capture.splits[split], streams))
        for name, split in SPLITS.items()
        if capture.splits.get(split)
    }


def measure_motions(
    avatar: Avatar,
    capture: MultiViewCapture,
    names: Sequence[str],
    streams: Collection[Stream] = STREAMS,
) -> dict[str, UnseenMotion]:
    """Return the figures of some sequences with garment truth, of an avatar with a garment's chart.

    Raises:
        CaptureError: a sequence, or all of training, lacks garment truth; or they differ in its points.
    """
    tracked = track_garment(avatar, capture, streams)
    free = free_points(capture)
    return {name: _measure(avatar, capture, name, tracked, free, streams) for name in names}


def free_points(capture: MultiViewCapture) -> Int64[Tensor, " p"]:
    """Return the points of the true garment that the body does not hold.

    Runs that begin otherwise part wherever cloth is free; all points count where no motion has a second run.

    Raises:
        CaptureError: sequences differ in their points.
    """
    truths = {name: capture.garment(name) for name in capture.motions if capture.garment_runs(name)}
    check_same_points({name: truth.shape[1] for name, truth in truths.items()}, capture.name)
    parted = [
        np.linalg.norm(capture.garment(name, run=1) - truth, axis=-1).max(0)
        for name, truth in truths.items()
        if capture.garment_runs(name) > 1
    ]
    points = next(iter(truths.values())).shape[1]
    free: Bool[np.ndarray, " v"] = np.max(parted, axis=0) > PINNED if parted else np.ones(points, dtype=bool)
    # Two equal runs say nothing.
    return torch.from_numpy((free if free.any() else ~free).nonzero()[0])


def roll_out_points(
    avatar: Avatar, capture: MultiViewCapture, name: str, tracked: TrackedGarment, streams: Collection[Stream]
) -> tuple[Float[Tensor, "f v 3"], Float[Tensor, "f v 3"], Float[Tensor, "f j 4 4"]]:
    """Return the garment's predicted points and the template's, world metres, and T_world_rest of joints.

    They are in main memory, as the truth is.
    """
    predicted, template, transforms = [], [], []
    for motion_window, output in network_outputs(avatar, capture.motions[name], streams=streams):
        pose = motion_window[0, 0]
        predicted.append(tracked.carry(pose, tracked.offsets(avatar, output)))
        template.append(tracked.carry(pose))
        transforms.append(pose)
    return torch.stack(predicted).cpu(), torch.stack(template).cpu(), torch.stack(transforms).cpu()


@torch.no_grad()
def _measure(
    avatar: Avatar,
    capture: MultiViewCapture,
    name: str,
    tracked: TrackedGarment,
    free: Int64[Tensor, " p"],
    streams: Collection[Stream],
) -> UnseenMotion:
    true = torch.from_numpy(capture.garment(name))[:, free]
    predicted, template, transforms = roll_out_points(avatar, capture, name, tracked, streams)
    predicted, template, fps = predicted[:, free], template[:, free], capture.fps
    second = None
    if capture.garment_runs(name) > 1:
        second = rms_error(torch.from_numpy(capture.garment(name, run=1))[:, free], true)
    stops = [
        measure_stop(stop, predicted - template, true - template, fps)
        for stop in find_stops(avatar.body.to(device="cpu"), transforms, fps)
    ]
    return UnseenMotion(
        mm=rms_error(predicted, true),
        mm_template=rms_error(template, true),
        mm_second=second,
        frames=len(true),
        stops=[stop for stop in stops if stop is not None],
    )


def rms_error(points: Float[Tensor, "f v 3"], true: Float[Tensor, "f v 3"]) -> float:
    """Return the root mean square distance of points from the true ones, over frames and points, mm."""
    return float((points - true).double().square().sum(-1).mean().sqrt()) * _MILLIMETRES


def summarize_motions(motions: dict[str, UnseenMotion]) -> UnseenFigures:
    """Return a split's figures: means over motions, and their ratio with a 95 % interval.

    The interval is of motions drawn with replacement: how else the ratio might have come out with other
    motions of these kinds. It is the same each time.
    """
    errors = np.array([(motion.mm, motion.mm_template) for motion in motions.values()])
    second = [motion.mm_second for motion in motions.values() if motion.mm_second is not None]
    draws = np.random.default_rng(0).integers(len(errors), size=(DRAWS, len(errors)))
    low, high = np.percentile([_ratio(errors[draw]) for draw in draws], [2.5, 97.5])
    return UnseenFigures(
        motions=motions,
        mm=float(errors[:, 0].mean()),
        mm_template=float(errors[:, 1].mean()),
        mm_second=statistics.fmean(second) if second else None,
        ratio=_ratio(errors),
        ratio_ci=(float(low), float(high)),
    )


def _ratio(errors: Float[np.ndarray, "m 2"]) -> float:
    mm, mm_template = errors.mean(0)
    # A cloth that never leaves its skinning by a nanometre is not loose.
    return float(mm / max(mm_template, 1e-6))


def describe_unseen(name: str, figures: UnseenFigures) -> str:
    """Return a line for a person."""
    low, high = figures.ratio_ci
    second = "" if figures.mm_second is None else f", a second true run {figures.mm_second:.1f}"
    return (
        f"unseen {name}: {figures.mm:.1f} mm, template {figures.mm_template:.1f}{second}; "
        f"ratio {figures.ratio:.3f} ({low:.3f} to {high:.3f}) over {len(figures.motions)} motions"
    )
