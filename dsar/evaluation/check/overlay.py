"""The posed body drawn over a capture's images, to be looked at."""

import dataclasses

import numpy as np
import torch
from jaxtyping import UInt8

from dsar.data.captures.multiview import MultiViewCapture
from dsar.errors import CaptureError
from dsar.evaluation.check.silhouettes import choose_frames, read, silhouette

HEIGHT = 360
"""Pixels of a picture's height at most."""
_BODY = np.array([255.0, 80.0, 40.0])
_SHARE = 0.45
_DIM = 0.35


def draw_overlays(
    capture: MultiViewCapture,
) -> tuple[dict[str, list[UInt8[np.ndarray, "h w 3"]]], list[str]]:
    """Return pictures by camera's name, one a frame, and the frames' names.

    Where the mask is empty the backdrop is dimmed, or black if the capture has none; the body is orange.
    White: no image that can be read.
    """
    seen = {
        (name, frame)
        for name, motion in capture.motions.items()
        for frame in range(len(motion))
        if capture.cameras_with_image(name, frame)
    }
    hypothesis, places = read(capture), choose_frames(capture.motions, seen)
    rows = {
        capture.cameras[index].name: [
            _draw(capture, hypothesis.vertices(*place), *place, index) for place in places
        ]
        for index in range(len(capture.cameras))
    }
    return rows, [f"{name} {frame}" for name, frame in places]


def _draw(
    capture: MultiViewCapture, vertices: torch.Tensor, sequence: str, frame: int, index: int
) -> UInt8[np.ndarray, "h w 3"]:
    camera = capture.cameras[index]
    reduction = -(-camera.height // HEIGHT)
    height, width = camera.height // reduction, camera.width // reduction
    white = np.full((height, width, 3), 255, np.uint8)
    if index not in capture.cameras_with_image(sequence, frame):
        return white
    try:
        image = capture.image(sequence, frame, index)
    except CaptureError:
        # The verdict names it; the others are still to be looked at.
        return white
    whole = dataclasses.replace(camera, width=width * reduction, height=height * reduction)
    pixels = image[: height * reduction, : width * reduction].astype(np.float32)
    small = pixels.reshape(height, reduction, width, reduction, 4).mean((1, 3))
    dim = _DIM if capture.backdrop else 0.0
    colors = small[..., :3] * (dim + (1 - dim) * small[..., 3:] / 255)
    body = _SHARE * silhouette(vertices, capture.body.faces, whole.resized(width, height)).numpy()[..., None]
    return (colors * (1 - body) + _BODY * body).clip(0, 255).astype(np.uint8)
