"""The images of a free rollout against the truth and the template, view by view.

A rollout starts cold on a sequence's first frame and is never corrected.
"""

import dataclasses
from collections.abc import Collection, Mapping
from types import MappingProxyType

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.rollout import START_FRAME, roll_out
from dsar.data.captures.multiview import MultiViewCapture
from dsar.evaluation.garment_metrics import garment_mask
from dsar.evaluation.image_metrics import ImageMetric
from dsar.evaluation.results import ViewMetrics
from dsar.evaluation.temporal_metrics import temporal_psnr, trace_back, warp_error
from dsar.evaluation.uncovered import RestingGarment, psnr_uncovered, touched_pixels
from dsar.evaluation.views import WHITE, View, render_white, true_view
from dsar.metrics.images import mask_box, psnr, ssim
from dsar.network import STREAMS, Stream
from dsar.raster import rasterize
from dsar.types import Camera, Capture, Gaussians

_SLOW_EVERY = 4
"""Of how many evaluated frames one has the metrics that take long."""
SLOWEST: Mapping[str, int] = {"lpips_vgg": 4}
"""Metrics that take a fifth of a second a view, and of how many such frames one has them."""


@torch.no_grad()
def evaluate_sequence(
    avatar: Avatar,
    capture: Capture,
    sequence: str,
    stride: int,
    *,
    streams: Collection[Stream] = STREAMS,
    perceptual: Mapping[str, ImageMetric] = MappingProxyType({}),
) -> list[ViewMetrics]:
    """Return the metrics of every view of every `stride`-th frame of one sequence.

    Of every 4th of them also those that take long: the `perceptual` ones, and those of two frames; of every
    16th those that take longest.
    """
    motion = capture.motions[sequence]
    signal = avatar.driving_signal(motion)
    garment = garment_ground_truth(capture, sequence)
    resting = RestingGarment.of(avatar)
    rows, before = [], None
    for number, gaussians in roll_out(avatar, motion, streams=streams):
        frame = number - START_FRAME
        if frame % stride == 0:
            template = avatar.gaussians(signal.windows[frame : frame + 1], None)[0]
            for index in capture.cameras_with_image(sequence, frame):
                camera = capture.cameras[index]
                truth = true_view(capture, sequence, frame, index, avatar.device)
                image = render_white(gaussians, camera)
                view = compare(frame, index, image, render_white(template, camera), truth)
                if garment is not None:
                    inside = garment_mask(garment[0][frame], garment[1], camera).to(avatar.device)
                    inside &= truth.mask > 0.5
                    if inside.any():
                        in_garment = psnr(image[inside][None], truth.color[inside][None])
                        view = dataclasses.replace(view, psnr_garment=in_garment)
                cover = true_cover(capture, garment, sequence, frame, index)
                if cover is not None and resting is not None:
                    at_rest = resting.silhouette(signal.transforms[frame], camera)
                    uncovered = psnr_uncovered(image, truth, cover.to(avatar.device), at_rest)
                    view = dataclasses.replace(view, psnr_uncovered=uncovered)
                slow = frame % (_SLOW_EVERY * stride) == 0
                if slow and before is not None and index in capture.cameras_with_image(sequence, frame - 1):
                    last = true_view(capture, sequence, frame - 1, index, avatar.device)
                    changes = compare_change((before, gaussians), camera, (last, truth), perceptual)
                    # The first frame has none before it.
                    round_number = frame // (_SLOW_EVERY * stride) - 1
                    due = [name for name in perceptual if round_number % SLOWEST.get(name, 1) == 0]
                    changes |= {name: perceptual[name](image, truth.color) for name in due}
                    view = dataclasses.replace(view, **changes)
                rows.append(view)
        before = gaussians
    return rows


def garment_ground_truth(
    capture: Capture, sequence: str
) -> tuple[Float[Tensor, "f v 3"], Int64[Tensor, "t 3"]] | None:
    """Return the garment's true vertices, world metres, and triangles; None where the capture has none."""
    if not (isinstance(capture, MultiViewCapture) and capture.garment_runs(sequence)):
        return None
    return torch.from_numpy(capture.garment(sequence)), torch.from_numpy(capture.garment_faces(sequence))


def true_cover(
    capture: Capture,
    garment: tuple[Float[Tensor, "f v 3"], Int64[Tensor, "t 3"]] | None,
    sequence: str,
    frame: int,
    camera: int,
) -> Bool[Tensor, "h w"] | None:
    """Return where the true garment is in an image, by its simulation or by labels; None without either."""
    if garment is not None:
        return touched_pixels(garment[0][frame], garment[1], capture.cameras[camera])
    labels = capture.garment_mask(sequence, frame, camera)
    return None if labels is None else torch.from_numpy(labels)


def compare(
    frame: int,
    camera: int,
    image: Float[Tensor, "h w 3"],
    template: Float[Tensor, "h w 3"],
    truth: View,
) -> ViewMetrics:
    """Return the metrics of one predicted view and of the template's."""
    x0, y0, x1, y1 = mask_box(truth.mask.cpu().numpy() > 0.5, 0)
    box = (slice(y0, y1), slice(x0, x1))
    return ViewMetrics(
        frame,
        camera,
        psnr=psnr(image, truth.color),
        psnr_box=psnr(image[box], truth.color[box]),
        psnr_box_template=psnr(template[box], truth.color[box]),
        ssim=float(ssim(image, truth.color)),
    )


def compare_change(
    gaussians: tuple[Gaussians, Gaussians],
    camera: Camera,
    truths: tuple[View, View],
    perceptual: Mapping[str, ImageMetric],
) -> dict[str, float]:
    """Return the temporal metrics of `ViewMetrics` of one view of two frames that follow each other.

    `tlpips` says how much more, or less, a frame differs from the one before than it does in truth (Chu et
    al. 2020).
    """
    before, now = (
        rasterize(moment, camera, background=WHITE.to(moment.means), outputs=("contributors",))
        for moment in gaussians
    )
    metrics = {"tpsnr": temporal_psnr((before.color, now.color), (truths[0].color, truths[1].color))}
    if "lpips" in perceptual:
        lpips = perceptual["lpips"]
        metrics["tlpips"] = abs(lpips(before.color, now.color) - lpips(truths[0].color, truths[1].color))
    error = warp_error(before, now, *trace_back(now, gaussians[1], gaussians[0], camera))
    return metrics if error is None else metrics | {"warp_error": error}
