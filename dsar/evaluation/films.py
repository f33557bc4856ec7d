"""Rollouts judged as films: every frame of every held-out sequence, from every camera, against the truth."""

import statistics
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.rollout import roll_out
from dsar.evaluation.frechet import CLIP, find_i3d, frechet_distance, i3d_features, slice_features
from dsar.evaluation.views import render_white, to_bytes, true_view
from dsar.evaluation.vmaf import vmaf, vmaf_missing
from dsar.network import STREAMS, Stream
from dsar.training.lpips import find_lpips_weights, load_lpips
from dsar.types import Capture

FILM_METRICS = ("vmaf", "frechet_slices", "fvd")
Film = UInt8[np.ndarray, "f h w 3"]


@torch.no_grad()
def record(
    avatar: Avatar, capture: Capture, sequence: str, streams: Collection[Stream] = STREAMS
) -> list[tuple[Film, Film]]:
    """Return the avatar's film and the true one of each camera."""
    cameras, made = capture.cameras, []
    for _, gaussians in roll_out(avatar, capture.motions[sequence], streams=streams):
        made.append([to_bytes(render_white(gaussians, camera)) for camera in cameras])
    true = [
        [to_bytes(true_view(capture, sequence, frame, index).color) for index in range(len(cameras))]
        for frame in range(len(made))
    ]
    return [
        (np.stack([row[index] for row in made]), np.stack([row[index] for row in true]))
        for index in range(len(cameras))
    ]


def evaluate_films(
    avatar: Avatar,
    capture: Capture,
    splits: Mapping[str, Sequence[str]],
    streams: Collection[Stream] = STREAMS,
) -> tuple[dict[str, dict[str, float]], dict[str, str]]:
    """Return the metrics of films of each split, and why others could not be measured."""
    judges, skipped = _judges()
    scores: dict[str, list[float]] = defaultdict(list)
    features: dict[tuple[str, str], list[tuple[Tensor, Tensor]]] = defaultdict(list)
    for sequence in {name: None for names in splits.values() for name in names}:
        for made, true in record(avatar, capture, sequence, streams):
            if "vmaf" not in skipped:
                scores[sequence].append(vmaf(made, true))
            for metric, judge in judges.items() if len(made) >= CLIP else ():
                features[metric, sequence].append((judge(made), judge(true)))
    found: dict[str, dict[str, float]] = {}
    for split, names in splits.items():
        found[split] = {}
        films = [score for name in names for score in scores[name]]
        if films:
            found[split]["vmaf"] = statistics.fmean(films)
        for metric in judges:
            pairs = [pair for name in names for pair in features[metric, name]]
            made, true = ([pair[side] for pair in pairs] for side in (0, 1))
            if sum(map(len, made)) > 1:
                found[split][metric] = frechet_distance(torch.cat(made), torch.cat(true))
            else:
                skipped[metric] = f"films of {CLIP} frames and more are needed"
    return found, skipped


def _judges() -> tuple[dict[str, Callable[[Film], Tensor]], dict[str, str]]:
    """Return what makes a film's features, by metric, and why metrics of films cannot be computed here."""
    judges: dict[str, Callable[[Film], Tensor]] = {}
    skipped = {}
    if reason := vmaf_missing():
        skipped["vmaf"] = reason
    if find_lpips_weights("alex").exists():
        judges["frechet_slices"] = partial(slice_features, network=load_lpips("alex"))
    else:
        skipped["frechet_slices"] = "LPIPS's weights are not on this machine: run tools/fetch_lpips.py"
    if path := find_i3d():
        judges["fvd"] = partial(i3d_features, network=torch.jit.load(path))
    else:
        skipped["fvd"] = "it needs I3D as a TorchScript file, named by $DSAR_I3D; see frechet_slices"
    return judges, skipped
