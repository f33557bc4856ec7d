"""Rollouts judged as videos: every frame of every held-out sequence, from every camera, against the truth."""

import statistics
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.rollout import roll_out
from dsar.evaluation.frechet import CLIP, Video, frechet_distance, i3d_features, load_i3d, slice_features
from dsar.evaluation.results import VideoMetrics
from dsar.evaluation.views import render_white, to_bytes, true_view
from dsar.evaluation.vmaf import vmaf, vmaf_missing
from dsar.metrics.lpips import find_lpips_weights, load_lpips
from dsar.network import STREAMS, Stream
from dsar.types import Capture


@torch.no_grad()
def record(
    avatar: Avatar, capture: Capture, sequence: str, camera: int, streams: Collection[Stream] = STREAMS
) -> tuple[Video, Video]:
    """Return the avatar's video and the true one, from one camera of the capture."""
    rollout = roll_out(avatar, capture.motions[sequence], streams=streams)
    predicted = [to_bytes(render_white(gaussians, capture.cameras[camera])) for _, gaussians in rollout]
    true = [to_bytes(true_view(capture, sequence, frame, camera).color) for frame in range(len(predicted))]
    return np.stack(predicted), np.stack(true)


def cameras_without_gaps(capture: Capture, sequence: str) -> list[int]:
    """Return the cameras that lack no frame of a sequence."""
    seen = (
        set(capture.cameras_with_image(sequence, frame)) for frame in range(len(capture.motions[sequence]))
    )
    return sorted(set.intersection(*seen))


def evaluate_videos(
    avatar: Avatar,
    capture: Capture,
    splits: Mapping[str, Sequence[str]],
    streams: Collection[Stream] = STREAMS,
) -> tuple[dict[str, VideoMetrics], dict[str, str]]:
    """Return the metrics of each split's videos, and why others could not be measured."""
    extractors, skipped = _feature_extractors()
    scores: dict[str, list[float]] = defaultdict(list)
    features: dict[tuple[str, str], list[tuple[Tensor, Tensor]]] = defaultdict(list)
    for sequence in {name: None for names in splits.values() for name in names}:
        # One camera's videos in memory at a time: a real capture's would fill it.
        for camera in cameras_without_gaps(capture, sequence):
            predicted, true = record(avatar, capture, sequence, camera, streams)
            if "vmaf" not in skipped:
                scores[sequence].append(vmaf(predicted, true))
            for metric, extract in extractors.items() if len(predicted) >= CLIP else ():
                features[metric, sequence].append((extract(predicted), extract(true)))
    splits_metrics: dict[str, VideoMetrics] = {}
    for split, names in splits.items():
        metrics: dict[str, float] = {}
        split_scores = [score for name in names for score in scores[name]]
        if not any(cameras_without_gaps(capture, name) for name in names):
            skipped |= dict.fromkeys(("vmaf", *extractors), "no camera has an image of every frame")
            splits_metrics[split] = VideoMetrics()
            continue
        if split_scores:
            metrics["vmaf"] = statistics.fmean(split_scores)
        for metric in extractors:
            pairs = [pair for name in names for pair in features[metric, name]]
            predicted, true = ([pair[side] for pair in pairs] for side in (0, 1))
            if sum(map(len, predicted)) > 1:
                metrics[metric] = frechet_distance(torch.cat(predicted), torch.cat(true))
            else:
                skipped[metric] = f"films of {CLIP} frames and more are needed"
        splits_metrics[split] = VideoMetrics(**metrics)
    return splits_metrics, skipped


def _feature_extractors() -> tuple[dict[str, Callable[[Video], Tensor]], dict[str, str]]:
    """Return what makes a video's features, by metric, and why metrics of videos cannot be computed here."""
    extractors: dict[str, Callable[[Video], Tensor]] = {}
    skipped = {}
    if reason := vmaf_missing():
        skipped["vmaf"] = reason
    if find_lpips_weights("alex").exists():
        extractors["frechet_slices"] = partial(slice_features, network=load_lpips("alex"))
    else:
        skipped["frechet_slices"] = "LPIPS's weights are not on this machine: run tools/fetch_lpips.py"
    if (network := load_i3d()) is not None:
        extractors["fvd"] = partial(i3d_features, network=network)
    else:
        skipped["fvd"] = "it needs I3D as a TorchScript file, named by $DSAR_I3D; see frechet_slices"
    return extractors, skipped
