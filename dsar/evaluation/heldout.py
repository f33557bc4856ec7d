"""Free rollouts on held-out sequences against the truth, the template, and the same pose's other past.

Every rollout starts cold on a sequence's first frame and is never corrected. Images are compared over
white; `box` is the bounding box of the true mask. Figures are means over views.
"""

import statistics
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.rollout import START_FRAME, roll_out
from dsar.data.captures.multiview import MultiViewCapture
from dsar.data.motions.mmd import PoseDistribution
from dsar.evaluation.garment_metrics import garment_mask, measure_garment
from dsar.evaluation.image_metrics import ImageMetric, correlation, load_perceptual
from dsar.evaluation.profiling import read_clock, time_stages
from dsar.evaluation.temporal_metrics import temporal_psnr, trace_back, warp_error
from dsar.evaluation.videos import VIDEO_METRICS, evaluate_videos
from dsar.evaluation.views import WHITE, View, render_white, true_view
from dsar.metrics.images import mask_box, psnr, ssim
from dsar.network import STREAMS, Stream
from dsar.network.session import InferenceSession
from dsar.raster import rasterize
from dsar.types import Camera, Capture, Gaussians

_IMAGE_METRICS = (
    "psnr",
    "psnr_box",
    "psnr_box_template",
    "psnr_garment",
    "ssim",
    "lpips",
    "lpips_vgg",
    "flip",
)
METRICS = (*_IMAGE_METRICS, "tpsnr", "tlpips", "warp_error", "mmd")
"""What a split has a figure of, or null."""
_SELDOM = 4
_RARE = {"lpips_vgg": 4}
"""Metrics that take a fifth of a second a view, and of how many such frames one has them."""
_WARM_UP = 10
_MOMENT = 15
"""Frames that look alike."""


@torch.no_grad()
def evaluate_sequence(
    avatar: Avatar,
    capture: Capture,
    sequence: str,
    stride: int,
    *,
    streams: Collection[Stream] = STREAMS,
    perceptual: Mapping[str, ImageMetric] = MappingProxyType({}),
) -> list[dict[str, float | int]]:
    """Return the metrics of every view of every `stride`-th frame of one sequence.

    Of every 4th of them also those that take long: the `perceptual` ones, and those of two frames; of every
    16th those that take longest.
    """
    motion = capture.motions[sequence]
    signal = avatar.driving_signal(motion)
    cloth = garment_ground_truth(capture, sequence)
    rows, before = [], None
    for number, gaussians in roll_out(avatar, motion, streams=streams):
        frame = number - START_FRAME
        if frame % stride == 0:
            template = avatar.gaussians(signal.windows[[frame]], None)[0]
            for index in capture.cameras_with_image(sequence, frame):
                camera, truth = capture.cameras[index], true_view(capture, sequence, frame, index)
                image = render_white(gaussians, camera)
                row: dict[str, float | int] = {"frame": frame, "camera": index}
                row |= compare(image, render_white(template, camera), truth)
                if cloth is not None:
                    dressed = garment_mask(cloth[0][frame], cloth[1], camera) & (truth.mask > 0.5)
                    if dressed.any():
                        row["psnr_garment"] = psnr(image[dressed][None], truth.color[dressed][None])
                seldom = frame % (_SELDOM * stride) == 0
                if seldom and before is not None and index in capture.cameras_with_image(sequence, frame - 1):
                    last = true_view(capture, sequence, frame - 1, index)
                    row |= compare_change((before, gaussians), camera, (last, truth), perceptual)
                    # The first frame has none before it.
                    turn = frame // (_SELDOM * stride) - 1
                    due = [name for name in perceptual if turn % _RARE.get(name, 1) == 0]
                    row |= {name: perceptual[name](image, truth.color) for name in due}
                rows.append(row)
        before = gaussians
    return rows


def garment_ground_truth(capture: Capture, sequence: str) -> tuple[Tensor, Tensor] | None:
    """Return the garment's true vertices [f,v,3] and triangles [t,3]; None where the capture has none."""
    if not (isinstance(capture, MultiViewCapture) and capture.garment_runs(sequence)):
        return None
    return torch.from_numpy(capture.garment(sequence)), torch.from_numpy(capture.garment_faces(sequence))


def compare(image: Tensor, template: Tensor, truth: View) -> dict[str, float]:
    """Return the metrics of one predicted view and of the template's."""
    x0, y0, x1, y1 = mask_box(truth.mask.numpy() > 0.5, 0)
    box = (slice(y0, y1), slice(x0, x1))
    return {
        "psnr": psnr(image, truth.color),
        "psnr_box": psnr(image[box], truth.color[box]),
        "psnr_box_template": psnr(template[box], truth.color[box]),
        "ssim": float(ssim(image, truth.color)),
    }


def compare_change(
    gaussians: tuple[Gaussians, Gaussians],
    camera: Camera,
    truths: tuple[View, View],
    perceptual: Mapping[str, ImageMetric],
) -> dict[str, float]:
    """Return the metrics of one view of two frames that follow each other.

    `tlpips` says how much more, or less, a frame differs from the one before than it does in truth (Chu et
    al. 2020).
    """
    before, now = (rasterize(each, camera, background=WHITE, outputs=("contributors",)) for each in gaussians)
    found = {"tpsnr": temporal_psnr((before.color, now.color), (truths[0].color, truths[1].color))}
    if "lpips" in perceptual:
        lpips = perceptual["lpips"]
        found["tlpips"] = abs(lpips(before.color, now.color) - lpips(truths[0].color, truths[1].color))
    error = warp_error(before, now, *trace_back(now, gaussians[1], gaussians[0], camera))
    return found if error is None else found | {"warp_error": error}


@torch.no_grad()
def one_to_many(
    avatar: Avatar, capture: MultiViewCapture, *, streams: Collection[Stream] = STREAMS
) -> dict[str, float] | None:
    """Return correlation and size ratio of predicted against true difference at one pose with two pasts.

    For each pair the images after a stop and at rest are subtracted, over all cameras that have them all,
    inside either true mask. A model without history predicts no difference: correlation 0, ratio 0.
    """
    predicted, true = [], []
    for pair in capture.one_to_many:
        after, rest = range(pair.after_stop[0], pair.after_stop[1] + 1), sum(pair.at_rest) // 2
        frames = {*after, rest}
        made = {
            number - START_FRAME: gaussians
            for number, gaussians in roll_out(avatar, capture.motions[pair.sequence], streams=streams)
            if number - START_FRAME in frames
        }
        seen = set.intersection(*(set(capture.cameras_with_image(pair.sequence, frame)) for frame in frames))
        for index in sorted(seen):
            camera = capture.cameras[index]
            still, still_image = (
                true_view(capture, pair.sequence, rest, index),
                render_white(made[rest], camera),
            )
            for frame in after:
                moved = true_view(capture, pair.sequence, frame, index)
                inside = (moved.mask > 0.5) | (still.mask > 0.5)
                true.append((moved.color - still.color)[inside].flatten())
                predicted.append((render_white(made[frame], camera) - still_image)[inside].flatten())
    if not true:
        return None
    p, t = torch.cat(predicted), torch.cat(true)
    return {"correlation": correlation(p, t), "ratio": float(p.norm() / t.norm())}


@torch.no_grad()
def time_rollout(
    avatar: Avatar, capture: Capture, sequence: str, frames: int = 100
) -> tuple[dict[str, float], dict[str, float]]:
    """Return milliseconds per frame of the network's parts, posing and rasterisation of one camera.

    Medians, and what 95 of 100 frames stay below; the first frames are left out. Posing includes the input
    maps, which are posed control points.
    """
    signal = avatar.driving_signal(capture.motions[sequence])
    session = InferenceSession(avatar.network)
    times: dict[str, list[float]] = defaultdict(list)
    for frame in range(_WARM_UP + frames):
        start = read_clock()
        motion_window = signal.windows[[frame % len(signal)]]
        maps, magnitude = avatar.standardize(avatar.input_maps(motion_window, avatar.fps))
        seen = read_clock()
        step = partial(session.step, maps, magnitude)
        output, parts = time_stages(session.network, step)
        made = read_clock()
        gaussians = avatar.gaussians(motion_window, output)[0]
        posed = read_clock()
        render_white(gaussians, capture.cameras[0])
        parts |= {"pose": 1e3 * (seen - start + posed - made), "raster": 1e3 * (read_clock() - posed)}
        for name, milliseconds in parts.items():
            times[name].append(milliseconds)
    rest = {name: values[_WARM_UP:] for name, values in times.items() if name != "total"}
    slowest = {name: statistics.quantiles(values, n=20)[-1] for name, values in rest.items()}
    return {name: statistics.median(values) for name, values in rest.items()}, slowest


def evaluate(
    avatar: Avatar, capture: MultiViewCapture, *, stride: int = 2, streams: Collection[Stream] = STREAMS
) -> dict[str, Any]:
    """Return the held-out figures of a run in the shape of the command-line contract.

    Without one of the `streams` images are those of an ablated network; garment and times are the whole's.
    """
    splits: dict[str, Any] = {}
    perceptual, skipped = load_perceptual()
    strides = dict.fromkeys(capture.splits["train"], 8 * stride)
    strides |= dict.fromkeys(capture.splits["test"], stride)
    quick = {name: metric for name, metric in perceptual.items() if name not in _RARE}
    by_sequence = {
        name: evaluate_sequence(
            avatar,
            capture,
            name,
            each,
            streams=streams,
            perceptual=quick if name in capture.splits["train"] else perceptual,
        )
        for name, each in strides.items()
    }
    skipped.setdefault("lpips_vgg", "on training sequences, for it takes long")
    if "lpips" in skipped:
        skipped["tlpips"] = skipped["lpips"]
    heldout = {split: list(capture.splits.get(split, ())) for split in ("test", "nd", "fd")}
    heldout = {split: names for split, names in heldout.items() if names}
    videos, missing = evaluate_videos(avatar, capture, heldout, streams)
    skipped |= missing
    training = PoseDistribution.from_motions(capture.motions[name] for name in capture.splits["train"])
    for split in ("train", "test", "nd", "fd"):
        names = [name for name in capture.splits.get(split, ()) if name in by_sequence]
        rows = summarize(by_sequence, names, len(capture.cameras)) if names else None
        if rows:
            motions = [capture.motions[name] for name in names]
            rows["mmd"] = training.mmd(motions) if split != "train" else 0.0
        splits[split] = rows and rows | dict.fromkeys(VIDEO_METRICS) | videos.get(split, {})
    garments = {name: measure_garment(avatar, capture, name, 2 * stride) for name in capture.splits["test"]}
    if not all(garment_ground_truth(capture, name) for name in by_sequence):
        skipped["psnr_garment"] = "the capture does not say where the garment is"
    if not all(garments.values()):
        skipped["garment"] = "no simulated garment in the capture, or no garment chart in the avatar"
    milliseconds, slowest = time_rollout(avatar, capture, capture.splits["test"][0])
    return {
        "splits": splits,
        "fps": 1e3 / sum(milliseconds.values()),
        "ms": milliseconds,
        "ms_p95": slowest,
        "gaussians": avatar.num_gaussians,
        "parameters": sum(p.numel() for p in avatar.network.parameters()),
        "one_to_many": one_to_many(avatar, capture, streams=streams),
        "garment": garments,
        "worst": worst_views(by_sequence, capture.splits["test"]),
        "skipped": skipped,
    }


def worst_views(
    by_sequence: Mapping[str, Sequence[Mapping[str, float | int]]], names: Sequence[str], count: int = 8
) -> list[dict[str, Any]]:
    """Return the views of some sequences with the lowest PSNR in the mask's box, one of each moment."""
    views = [{"sequence": name, **row} for name in names for row in by_sequence[name]]
    found: dict[tuple[str, int], dict[str, Any]] = {}
    for view in sorted(views, key=lambda view: view["psnr_box"]):
        found.setdefault((view["sequence"], view["frame"] // _MOMENT), view)
    keys = ("sequence", "frame", "camera", "psnr_box")
    return [{key: view[key] for key in keys} for view in list(found.values())[:count]]


def summarize(
    by_sequence: Mapping[str, Sequence[Mapping[str, float | int]]], names: Sequence[str], views: int
) -> dict[str, float | int | None]:
    """Return means over all views of some sequences that have a figure; null where none has."""
    rows = [row for name in names for row in by_sequence[name]]
    means: dict[str, float | int | None] = {}
    for key in METRICS:
        values = [row[key] for row in rows if key in row]
        means[key] = statistics.fmean(values) if values else None
    frames = {(name, row["frame"]) for name in names for row in by_sequence[name]}
    return means | {"frames": len(frames), "views": views}
