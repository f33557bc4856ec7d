"""One pose with two pasts: whether the predicted images differ as the true ones do."""

from collections.abc import Collection

import torch

from dsar.avatar.avatar import Avatar
from dsar.avatar.rollout import START_FRAME, roll_out
from dsar.data.captures.multiview import MultiViewCapture
from dsar.evaluation.image_metrics import correlation
from dsar.evaluation.results import OneToManyFigures
from dsar.evaluation.views import render_white, true_view
from dsar.network import STREAMS, Stream


@torch.no_grad()
def one_to_many(
    avatar: Avatar, capture: MultiViewCapture, *, streams: Collection[Stream] = STREAMS
) -> OneToManyFigures | None:
    """Return correlation and size ratio of predicted against true difference at one pose with two pasts.

    For each pair the images after a stop and at rest are subtracted, over all cameras that have them all,
    inside either true mask. A model without history predicts no difference: correlation 0, ratio 0. None
    where the capture has no such pair.
    """
    predicted_differences, true_differences = [], []
    for pair in capture.one_to_many:
        after_stop, rest = range(pair.after_stop[0], pair.after_stop[1] + 1), sum(pair.at_rest) // 2
        frames = {*after_stop, rest}
        predicted = {
            number - START_FRAME: gaussians
            for number, gaussians in roll_out(avatar, capture.motions[pair.sequence], streams=streams)
            if number - START_FRAME in frames
        }
        cameras = set.intersection(
            *(set(capture.cameras_with_image(pair.sequence, frame)) for frame in frames)
        )
        for index in sorted(cameras):
            camera = capture.cameras[index]
            true_rest = true_view(capture, pair.sequence, rest, index, avatar.device)
            predicted_rest = render_white(predicted[rest], camera)
            for frame in after_stop:
                true = true_view(capture, pair.sequence, frame, index, avatar.device)
                inside = (true.mask > 0.5) | (true_rest.mask > 0.5)
                true_differences.append((true.color - true_rest.color)[inside].flatten())
                image = render_white(predicted[frame], camera)
                predicted_differences.append((image - predicted_rest)[inside].flatten())
    if not true_differences:
        return None
    p, t = torch.cat(predicted_differences), torch.cat(true_differences)
    return OneToManyFigures(correlation(p, t), float(p.norm() / t.norm()))
