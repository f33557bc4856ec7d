"""The comparison itself: cameras, proxy geometry, splats and gradients, each by two renderers."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.geometry.camera_faults import PROJECTION_FAULTS, explain_projection
from dsar.geometry.cameras import farthest_cameras, look_at
from dsar.raster import rasterize
from dsar.types import Camera, Gaussians
from dsar_render.crosscheck import proxies, splats
from dsar_render.crosscheck.backend import LLVM
from dsar_render.crosscheck.points import (
    Projection,
    Residuals,
    SphereObservations,
    camera_projection,
    matrix_projection,
    project_spheres,
)
from dsar_render.crosscheck.proxies import Agreement, Hits, MitsubaScene, Shape
from dsar_render.crosscheck.verdict import CameraVerdict, Image, SplatVerdict, Verdict

Reporter = Callable[[str, float], None]

TOLERANCE_PX = 0.05
"""Root mean square of the residuals up to which cameras are the same."""
_LEAST_PIXELS, _MOST_PIXELS = 256, 512
"""Between which the shorter and the longer side of a proxy's image lie."""
_CLOSEUPS, _CLOSEUP_PX, _SPLAT_PX = 2, 256, 4.0
_SMALL_PX = 64
"""Side of the image that is explained Gaussian by Gaussian."""
_MAX_COMPARED = 40
"""How many Gaussians of that image have their gradients compared."""


def cross_check(
    mi: Any,
    cameras: Sequence[Camera],
    file_projections: Mapping[str, Mapping[str, Float[np.ndarray, "4 4"]]],
    shapes: Sequence[Shape],
    gaussians: Gaussians | None,
    report: Reporter = lambda *_: None,
) -> Verdict:
    """Compare our cameras, files and splats with Mitsuba's.

    Args:
        mi: Mitsuba.
        cameras: At least one.
        file_projections: By format and camera, how files project the world to pixels (rows 0, 1 and 3).
        shapes: Proxy geometry before the cameras.
        gaussians: Of an avatar; without them there are no splats to compare.
        report: Is told what is being done, and the share of it that is done.
    """
    scene, verdicts, pictures = MitsubaScene(mi, shapes), [], {}
    skipped: dict[str, str] = {}
    for index, camera in enumerate(cameras):
        report(camera.name, index / (len(cameras) + 2))
        sources = {"ours": camera_projection(camera)}
        sources |= {
            kind: matrix_projection(matrices[camera.name]) for kind, matrices in file_projections.items()
        }
        view = _proxy_view(camera)
        ours, theirs = proxies.rasterize_shapes(shapes, view), scene.trace(view)
        verdict = _compare_camera(camera, project_spheres(mi, camera), sources, proxies.compare(ours, theirs))
        # The first, and every one that is wrong.
        if index == 0 or verdict.faults:
            pictures[f"proxies, {camera.name}"] = _proxy_pictures(ours, theirs)
        if not verdict.sees_proxy:
            skipped[f"{camera.name}, proxies"] = "sees nothing of the body"
        verdicts.append(verdict)
    report("seeded mistakes", len(cameras) / (len(cameras) + 2))
    seeds = seed_mistakes(mi, cameras[0])
    if gaussians is None:
        skipped["splat_psnr"] = "a capture has no Gaussians: give a run"
    elif mi.variant() != LLVM:
        skipped["splat_psnr"] = f"Mitsuba traces Gaussians in {LLVM} only: install libllvm19"
    report("splats", (len(cameras) + 1) / (len(cameras) + 2))
    splat_verdict = None
    if gaussians is not None and "splat_psnr" not in skipped:
        splat_verdict, splat_pictures = _compare_splats(mi, gaussians, cameras)
        pictures |= splat_pictures
        if splat_verdict is None:
            skipped["splat_psnr"] = "no camera sees a Gaussian"
    return Verdict(mi.variant(), tuple(verdicts), seeds, splat_verdict, skipped, pictures)


def seed_mistakes(mi: Any, camera: Camera) -> dict[str, str | None]:
    """Return what each mistake, made on purpose in a camera, is taken for; None where it goes unnoticed.

    Not that camera itself, for without an off-centre principal point, oblong pixels and a pose of no
    symmetry some make no difference: one with an image of its size.
    """
    width, height = camera.width, camera.height
    K = torch.tensor([[1.1 * width, 0.0, 0.57 * width], [0.0, 1.3 * width, 0.46 * height], [0.0, 0.0, 1.0]])
    T = look_at(np.array([1.3, 0.9, 2.6]), np.array([0.1, -0.3, 0.2]))
    probe = Camera(K, _roll(T, 0.2), width, height, "probe")
    observations = project_spheres(mi, probe)
    return {
        fault.name: find_fault(probe, observations, camera_projection(fault.changes[0](probe)))
        for fault in PROJECTION_FAULTS
    }


def find_fault(camera: Camera, observations: SphereObservations, source: Projection) -> str | None:
    """Return the mistake that a projection has made, `unknown` if it is none of the usual; None if none.

    Args:
        camera: The right one.
        observations: Through it.
        source: What is tried.
    """
    if Residuals.from_distances(observations.residuals(source)).rms <= TOLERANCE_PX:
        return None
    # Where Mitsuba itself sees them elsewhere, the mistake is in what it was told.
    ours = Residuals.from_distances(observations.residuals(camera_projection(camera)))
    pixels = source(observations.points) if ours.rms <= TOLERANCE_PX else observations.pixels
    mistake = explain_projection(camera, observations.points, pixels, TOLERANCE_PX)
    return mistake.name if mistake else "unknown"


def _compare_camera(
    camera: Camera, observations: SphereObservations, sources: Mapping[str, Projection], proxy: Agreement
) -> CameraVerdict:
    residuals = {
        name: Residuals.from_distances(observations.residuals(source)) for name, source in sources.items()
    }
    faults = {name: find_fault(camera, observations, source) for name, source in sources.items()}
    mistakes = {name: fault for name, fault in faults.items() if fault is not None}
    return CameraVerdict(camera.name, residuals, mistakes, proxy)


def _compare_splats(
    mi: Any, gaussians: Gaussians, cameras: Sequence[Camera]
) -> tuple[SplatVerdict | None, dict[str, list[Image]]]:
    """Return what is found where some cameras come close, and pictures; None if no camera sees a Gaussian."""
    seeing = [camera for camera in cameras if splats.closeup(gaussians, camera, _CLOSEUP_PX, _SPLAT_PX)]
    if not seeing:
        return None, {}
    decibels, coverage, explanations, pictures = [], [], {}, {}
    for camera in farthest_cameras(seeing, min(_CLOSEUPS, len(seeing))):
        view, small = _closeups(gaussians, camera)
        visible = splats.visible_from(gaussians, view)
        ours, theirs = rasterize(visible, view), splats.GaussianScene(mi, visible).trace(view)
        covered = splats.GaussianScene(mi, splats.whiten(visible)).trace(view)[..., 0]
        decibels.append(splats.psnr(ours.color.numpy(), theirs.numpy()))
        coverage.append(splats.coverage_difference(ours.alpha, covered))
        explanations[camera.name] = splats.explain(mi, gaussians, small)
        pictures[f"splats, {camera.name}"] = _side_by_side(ours.color, theirs)
    _, small = _closeups(gaussians, seeing[0])
    # So few that they hardly hide each other: where they do, the orders differ, and so do right gradients.
    few = splats.visible_from(gaussians, small)
    few = few.map(lambda values: values[:: max(1, len(values) // _MAX_COMPARED)])
    pairs = splats.gradients(mi, few, small)
    slopes = {name: splats.correlation_and_slope(*pair) for name, pair in pairs.items()}
    return SplatVerdict(min(decibels), max(coverage), explanations, slopes), pictures


def _closeups(gaussians: Gaussians, camera: Camera) -> tuple[Camera, Camera]:
    """Return a close view of a camera that sees some, and its middle, which is explained."""
    view = splats.closeup(gaussians, camera, _CLOSEUP_PX, _SPLAT_PX)
    assert view is not None
    corner = (_CLOSEUP_PX - _SMALL_PX) // 2
    return view, view.cropped(corner, corner, _SMALL_PX, _SMALL_PX)


def _roll(T_camera_world: Float[Tensor, "4 4"], angle: float) -> Float[Tensor, "4 4"]:
    """Return the view of a camera turned about its axis, radians."""
    roll = torch.eye(4)
    roll[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return roll @ T_camera_world


def _proxy_view(camera: Camera) -> Camera:
    """Return the camera with an image large enough to compare silhouettes, and no larger than that needs."""
    short, long = sorted((camera.width, camera.height))
    scale = max(_LEAST_PIXELS / short, min(1.0, _MOST_PIXELS / long))
    return camera.resized(math.ceil(camera.width * scale), math.ceil(camera.height * scale))


def _proxy_pictures(ours: Hits, theirs: Hits) -> list[Image]:
    both = ours.depth[ours.hit] if ours.hit.any() else torch.tensor([0.0, 1.0])
    near, far = float(both.min()), float(both.max())

    def shade(hits: Hits) -> Tensor:
        gray = torch.where(hits.hit, 1 - 0.8 * ((hits.depth - near) / max(far - near, 1e-6)).clamp(0, 1), 0.0)
        return gray[..., None].expand(*gray.shape, 3)

    return _side_by_side(shade(ours), shade(theirs))


def _side_by_side(ours: Float[Tensor, "h w 3"], theirs: Float[Tensor, "h w 3"]) -> list[Image]:
    """Return both, and eight times their difference."""
    images = (ours, theirs, 8 * (ours - theirs).abs())
    return [(image.clamp(0, 1) * 255).round().byte().numpy() for image in images]
