"""Pictures: what one camera sees of one frame while its shutter is open."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float

from dsar.color import linear_from_srgb, srgb_from_linear
from dsar.geometry.camera_paths import CameraPath
from dsar.raster import Output, rasterize
from dsar.types import Camera, Picture, RenderOutput
from dsar_render.aovs import RASTER_OUTPUTS, TimeSample, make_aovs, part_coverage
from dsar_render.deep import sample_deep
from dsar_render.labels import Labels
from dsar_render.settings import RenderSettings
from dsar_render.triplets import FrameTriplet

_MIN_ALPHA = 1e-6
"""Below this coverage a colour has no digits left."""


def render_picture(
    triplet: FrameTriplet,
    path: CameraPath,
    settings: RenderSettings,
    *,
    labels: Labels | None = None,
    fps: float = 24.0,
    provenance: Mapping[str, str] | None = None,
) -> Picture:
    """Return the picture that a camera takes of a frame.

    Everything but colour, alpha and coverage is that of the frame itself, sharp, whatever the shutter does.

    Args:
        triplet: The frame; with its neighbours if `settings.needs_neighbours`.
        path: The camera.
        settings: What is wanted.
        labels: Parts of the Gaussians; for `crypto`.
        fps: Frames per second.
        provenance: Written into files of the picture.
    """
    view = path.at(triplet.frame)
    current = TimeSample(triplet.current, _with_overscan(view, settings.overscan))
    names = set(settings.aovs)
    raster_outputs: list[Output] = [output for name, output in RASTER_OUTPUTS.items() if name in names]
    if settings.deep:
        raster_outputs.append("contributors")
    deep = None
    with torch.no_grad():
        output = rasterize(current.gaussians, current.camera, outputs=raster_outputs)
        previous, following = (_neighbour(triplet, path, step, settings.overscan) for step in (-1, 1))
        aovs = make_aovs(names, output, current, previous, following, labels)
        if settings.deep:
            deep = sample_deep(
                output, current.gaussians, current.camera, max_samples=settings.deep_max_samples
            )
        if settings.times != [0.0]:
            samples = [_shutter_sample(triplet, path, time, settings.overscan) for time in settings.times]
            output, coverage = _average_exposure(output, samples, labels if "crypto" in names else None)
            aovs = dataclasses.replace(aovs, coverage=coverage)
    return Picture(
        frame=triplet.frame,
        camera=view,
        output=dataclasses.replace(output, contributors=None),
        aovs=aovs,
        deep=deep,
        overscan=settings.overscan,
        shutter=settings.shutter,
        fps=fps,
        guarded=triplet.guarded,
        provenance=provenance or {},
    )


def _with_overscan(camera: Camera, overscan: int) -> Camera:
    """Return the camera with an image that is larger on all sides."""
    size = camera.width + 2 * overscan, camera.height + 2 * overscan
    return camera.cropped(-overscan, -overscan, *size) if overscan else camera


def _neighbour(triplet: FrameTriplet, path: CameraPath, step: int, overscan: int) -> TimeSample | None:
    """Return the frame before or after, None where there is none."""
    gaussians = triplet.following if step > 0 else triplet.previous
    if gaussians is None:
        return None
    return TimeSample(gaussians, _with_overscan(path.at(triplet.frame + step), overscan))


def _shutter_sample(triplet: FrameTriplet, path: CameraPath, time: float, overscan: int) -> TimeSample:
    """Return the scene at a time within the frame, in frames from its own."""
    return TimeSample(triplet.interpolate(time), _with_overscan(path.at(triplet.frame + time), overscan))


def _average_exposure(
    unblurred: RenderOutput, samples: list[TimeSample], labels: Labels | None
) -> tuple[RenderOutput, dict[str, torch.Tensor]]:
    """Return the image with the samples' mean light and coverage, and the mean coverage of parts."""
    light, alpha = np.zeros(unblurred.color.shape, np.float32), torch.zeros_like(unblurred.alpha)
    coverage: dict[str, torch.Tensor] = {}
    for sample in samples:
        image = rasterize(sample.gaussians, sample.camera)
        weight = 1 / len(samples)
        light += _linear_light(image) * np.float32(weight)
        alpha += image.alpha * weight
        if labels is not None:
            parts = part_coverage(sample, labels)
            coverage = {name: coverage.get(name, 0) + part * weight for name, part in parts.items()}
    covered = alpha[..., None].numpy()
    straight = np.divide(light, covered, out=np.zeros_like(light), where=covered > _MIN_ALPHA)
    color = torch.from_numpy(srgb_from_linear(straight) * covered)
    return dataclasses.replace(unblurred, color=color, alpha=alpha), coverage


def _linear_light(output: RenderOutput) -> Float[np.ndarray, "h w 3"]:
    """Return the linear light of an image, premultiplied: what a film's exposure adds up."""
    covered, color = output.alpha[..., None].numpy(), output.color.numpy()
    straight = np.divide(color, covered, out=np.zeros_like(color), where=covered > _MIN_ALPHA)
    return linear_from_srgb(straight) * covered
