"""The figures of a run: free rollouts on held-out sequences against the truth, and what they cost.

Every rollout starts cold on a sequence's first frame and is never corrected. Images are compared over
white; `box` is the bounding box of the true mask. Figures are means over views.
"""

import dataclasses
import statistics
from collections.abc import Collection, Mapping, Sequence

from dsar.avatar.avatar import Avatar
from dsar.data.captures.multiview import MultiViewCapture
from dsar.data.motions.mmd import PoseDistribution
from dsar.evaluation.garment_metrics import measure_garment
from dsar.evaluation.image_metrics import ImageMetric, load_perceptual
from dsar.evaluation.one_to_many import one_to_many
from dsar.evaluation.profiling import time_rollout
from dsar.evaluation.results import HeldoutFigures, SplitMetrics, VideoMetrics, ViewMetrics, WorstView
from dsar.evaluation.unseen import measure_unseen, unseen_missing
from dsar.evaluation.videos import evaluate_videos
from dsar.evaluation.view_metrics import SLOWEST, evaluate_sequence, garment_ground_truth
from dsar.network import STREAMS, Stream

_VIEW_METRICS = tuple(
    field.name for field in dataclasses.fields(ViewMetrics) if field.name not in ("frame", "camera")
)
_HELD_OUT = ("test", "nd", "fd")
_MOMENT = 15
"""Frames that look alike."""


def evaluate(
    avatar: Avatar, capture: MultiViewCapture, *, stride: int = 2, streams: Collection[Stream] = STREAMS
) -> HeldoutFigures:
    """Return the held-out figures of a run.

    Without one of the `streams` images and unseen motions are those of an ablated network; the garment's
    shape and times are the whole's.
    """
    perceptual, skipped = load_perceptual(avatar.device)
    by_sequence = _evaluate_sequences(avatar, capture, stride, streams, perceptual)
    skipped.setdefault("lpips_vgg", "on training sequences, for it takes long")
    if "lpips" in skipped:
        skipped["tlpips"] = skipped["lpips"]
    held_out = {split: list(names) for split in _HELD_OUT if (names := capture.splits.get(split))}
    videos, missing = evaluate_videos(avatar, capture, held_out, streams)
    skipped |= missing
    splits = _summarize_splits(capture, by_sequence, videos)
    garments = {name: measure_garment(avatar, capture, name, 2 * stride) for name in capture.splits["test"]}
    if not all(garment_ground_truth(capture, name) for name in by_sequence):
        skipped["psnr_garment"] = "the capture does not say where the garment is"
    if any(split is not None and split.psnr_uncovered is None for split in splits.values()):
        skipped["psnr_uncovered"] = (
            "the avatar has no garment chart"
            if not avatar.garments
            else "the capture does not say where the garment is, or it never leaves the body free"
        )
    if avatar.borrowed_share is None:
        skipped["borrowed"] = "no garment covers the avatar's body, or it was trained before this was kept"
    if not all(garments.values()):
        skipped["garment"] = "no simulated garment in the capture, or no garment chart in the avatar"
    if missing_unseen := unseen_missing(avatar, capture):
        skipped["unseen"] = missing_unseen
    unseen = None if missing_unseen else measure_unseen(avatar, capture, streams)
    times = time_rollout(avatar, capture, capture.splits["test"][0])
    return HeldoutFigures(
        splits=splits,
        fps=times.fps,
        ms=times.ms,
        ms_p95=times.ms_p95,
        gaussians=avatar.num_gaussians,
        parameters=sum(p.numel() for p in avatar.network.parameters()),
        one_to_many=one_to_many(avatar, capture, streams=streams),
        garment=garments,
        borrowed=avatar.borrowed_share,
        unseen=unseen,
        worst=worst_views(by_sequence, capture.splits["test"]),
        skipped=skipped,
    )


def _evaluate_sequences(
    avatar: Avatar,
    capture: MultiViewCapture,
    stride: int,
    streams: Collection[Stream],
    perceptual: Mapping[str, ImageMetric],
) -> dict[str, list[ViewMetrics]]:
    """Return the views' metrics by sequence: of training fewer frames, and without the slowest metrics."""
    train, test = capture.splits["train"], capture.splits["test"]
    strides = dict.fromkeys(train, 8 * stride) | dict.fromkeys(test, stride)
    quick = {name: metric for name, metric in perceptual.items() if name not in SLOWEST}
    return {
        name: evaluate_sequence(
            avatar,
            capture,
            name,
            sequence_stride,
            streams=streams,
            perceptual=quick if name in train else perceptual,
        )
        for name, sequence_stride in strides.items()
    }


def _summarize_splits(
    capture: MultiViewCapture,
    by_sequence: Mapping[str, Sequence[ViewMetrics]],
    videos: Mapping[str, VideoMetrics],
) -> dict[str, SplitMetrics | None]:
    training = PoseDistribution.from_motions(capture.motions[name] for name in capture.splits["train"])
    splits: dict[str, SplitMetrics | None] = {}
    for split in ("train", *_HELD_OUT):
        names = [name for name in capture.splits.get(split, ()) if name in by_sequence]
        if not names:
            splits[split] = None
            continue
        mmd = 0.0 if split == "train" else training.mmd(capture.motions[name] for name in names)
        views = {name: by_sequence[name] for name in names}
        splits[split] = summarize(views, len(capture.cameras), mmd, videos.get(split, VideoMetrics()))
    return splits


def summarize(
    by_sequence: Mapping[str, Sequence[ViewMetrics]], cameras: int, mmd: float, videos: VideoMetrics
) -> SplitMetrics:
    """Return means over all views of some sequences that have a figure; None where none has.

    Args:
        by_sequence: The views of a split's sequences.
        cameras: How many the capture has.
        mmd: The split's poses' distance from those of training.
        videos: The split's.
    """
    rows = [view for views in by_sequence.values() for view in views]
    means: dict[str, float | None] = {}
    for key in _VIEW_METRICS:
        values = [value for view in rows if (value := getattr(view, key)) is not None]
        means[key] = statistics.fmean(values) if values else None
    frames = {(name, view.frame) for name, views in by_sequence.items() for view in views}
    return SplitMetrics(**means, mmd=mmd, frames=len(frames), views=cameras, **dataclasses.asdict(videos))


def worst_views(
    by_sequence: Mapping[str, Sequence[ViewMetrics]], names: Sequence[str], count: int = 8
) -> list[WorstView]:
    """Return the views of some sequences with the lowest PSNR in the mask's box, one of each moment."""
    views = [
        WorstView(name, view.frame, view.camera, view.psnr_box)
        for name in names
        for view in by_sequence[name]
    ]
    moments: dict[tuple[str, int], WorstView] = {}
    for view in sorted(views, key=lambda view: view.psnr_box):
        moments.setdefault((view.sequence, view.frame // _MOMENT), view)
    return list(moments.values())[:count]
