"""Gaussians themselves: our splats against Mitsuba's ray tracing of them, and why they differ."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.geometry.cameras import project
from dsar.raster import rasterize
from dsar.types import Camera, Gaussians
from dsar_render.crosscheck.oracle import EXTENT, OURS, STEPS, TRACED_STOP, blend
from dsar_render.crosscheck.sensors import make_sensor, pixel_centers, square_pixels

_SCALE = 100.0
"""Mitsuba steps over what it has met by 1e-4, whatever the unit: in larger scenes that is nothing."""
_MAX_DEPTH = 1024
"""Gaussians along a ray."""
_WHITE = 0.5 / 0.28209479177387814
"""DC coefficient of a channel that is 1."""


@dataclass(frozen=True)
class StepEffect:
    """One thing that renderers do differently, and what it changes."""

    name: str
    mean: float
    """Mean absolute change of colours."""
    psnr: float
    """Decibels between the image before and after."""


@dataclass(frozen=True)
class Explanation:
    """From our image to Mitsuba's, one difference at a time."""

    ours: float
    """Mean absolute difference of our rasteriser and its definition."""
    steps: tuple[StepEffect, ...]
    theirs: float
    """Mean absolute difference of Mitsuba and its definition: what is left unexplained."""


class GaussianScene:
    """Gaussians as Mitsuba holds them; in a variant that traces them."""

    def __init__(self, mi: Any, gaussians: Gaussians) -> None:
        self._mi = mi
        self._integrator = mi.load_dict(
            {"type": "volprim_rf_basic", "srgb_primitives": False, "max_depth": _MAX_DEPTH}
        )
        self.scene = mi.load_dict({"type": "scene", "gaussians": _ellipsoid_mesh(mi, gaussians)})
        self.parameters = mi.traverse(self.scene)

    def trace(self, camera: Camera) -> Float[Tensor, "h w 3"]:
        """Return the colours, premultiplied, that rays through the pixels' centres bring."""
        import drjit as dr

        light, *_ = self._integrator.sample(
            *(dr.ADMode.Primal, self.scene, *self.rays(camera)), None, None, self._mi.Bool(True)
        )
        image = np.array(light, np.float32).T
        return torch.from_numpy(np.ascontiguousarray(image)).view(camera.height, camera.width, 3)

    def backpropagate(self, camera: Camera, weights: Float[Tensor, "h w 3"]) -> None:
        """Add to the parameters' gradients those of the sum of colours times weights."""
        import drjit as dr

        mi, active = self._mi, self._mi.Bool(True)
        flat = weights.reshape(-1, 3).numpy().astype(np.float32)
        change = mi.Spectrum(*(mi.Float(np.ascontiguousarray(flat[:, channel])) for channel in range(3)))
        # The integrator resumes gradients itself where it wants them.
        with dr.suspend_grad():
            light, *_ = self._integrator.sample(
                *(dr.ADMode.Primal, self.scene, *self.rays(camera)), None, None, active
            )
            self._integrator.sample(
                *(dr.ADMode.Backward, self.scene, *self.rays(camera)), change, light, active
            )
            dr.eval()

    def rays(self, camera: Camera) -> tuple[Any, Any]:
        """Return a sampler, which tracing has no use for, and the rays through the pixels' centres."""
        mi = self._mi
        larger = dataclasses.replace(camera, T_camera_world=_scale_translation(camera.T_camera_world))
        sensor = mi.load_dict(make_sensor(mi, square_pixels(larger)[0], unit=_SCALE))
        film = pixel_centers(larger).astype(np.float32)
        x, y = (mi.Float(np.ascontiguousarray(film[:, axis])) for axis in (0, 1))
        rays, _ = sensor.sample_ray(mi.Float(0), mi.Float(0), mi.Point2f(x, y), mi.Point2f(0.5))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, len(film))
        return sampler, rays


def whiten(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians that are white from all sides: their image is their coverage."""
    harmonics = torch.zeros_like(gaussians.harmonics)
    harmonics[:, 0] = _WHITE
    return dataclasses.replace(gaussians, harmonics=harmonics)


def closeup(gaussians: Gaussians, camera: Camera, size: int, pixels: float) -> Camera | None:
    """Return the view of a camera, so much closer that most Gaussians in it are some pixels large.

    None where the camera sees none.

    Args:
        gaussians: What it sees.
        camera: Where it stands.
        size: Width and height of the image in pixels.
        pixels: The median of the largest standard deviations, in the image, of the Gaussians that it sees.
    """
    places, depth = project(camera, gaussians.means)
    borders = torch.tensor([camera.width, camera.height])
    visible = (depth > 0) & ((places > 0) & (places < borders)).all(-1)
    if not visible.any():
        return None
    places, depth = places[visible], depth[visible]
    extent = _focal(camera) * gaussians.scales[visible].amax(-1) / depth
    zoom = pixels / float(extent.median())
    near = camera.resized(math.ceil(camera.width * zoom), math.ceil(camera.height * zoom))
    # About the one that is nearest to the middle of all, which may itself lie in a gap.
    middle = places[(places - places.median(0).values).norm(dim=-1).argmin()]
    middle = middle * torch.tensor([near.width, near.height]) / borders
    left, top = (round(float(value) - size / 2) for value in middle)
    return near.cropped(left, top, size, size)


def visible_from(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """Return the Gaussians that may reach an image."""
    places, depth = project(camera, gaussians.means)
    reach = (EXTENT + 1) * gaussians.scales.amax(-1) * _focal(camera) / depth
    size = torch.tensor([camera.width, camera.height])
    inside = (depth > 0) & ((places > -reach[:, None]) & (places < size + reach[:, None])).all(-1)
    return gaussians.map(lambda values: values[inside])


def explain(mi: Any, gaussians: Gaussians, camera: Camera) -> Explanation:
    """Return what lies between our image of a small scene and Mitsuba's, one difference at a time."""
    visible = visible_from(gaussians, camera)
    image = blend(visible, camera, OURS)[..., :3]
    ours = np.abs(image - rasterize(visible, camera).color.double().numpy()).mean()
    steps = []
    for step in STEPS:
        changed = blend(visible, camera, step.choices)[..., :3]
        change = float(np.abs(changed - image).mean())
        steps.append(StepEffect(step.name, change, psnr(changed, image)))
        image = changed
    theirs = np.abs(image - GaussianScene(mi, visible).trace(camera).double().numpy()).mean()
    return Explanation(float(ours), tuple(steps), float(theirs))


def coverage_difference(ours: Float[Tensor, "h w"], theirs: Float[Tensor, "h w"]) -> float:
    """Return the mean absolute difference of coverage, up to where Mitsuba follows light no further."""
    most = 1 - TRACED_STOP
    return float((ours.clamp_max(most) - theirs.clamp_max(most)).abs().mean())


def psnr(one: Float[np.ndarray, "h w c"], two: Float[np.ndarray, "h w c"]) -> float:
    """Return the decibels between two images with a peak of 1."""
    error = float(((one - two) ** 2).mean())
    return float("inf") if error == 0 else -10 * math.log10(error)


def gradients(
    mi: Any, gaussians: Gaussians, camera: Camera, seed: int = 0
) -> dict[str, tuple[Float[Tensor, "..."], Float[Tensor, "..."]]]:
    """Return ours and Mitsuba's gradients of a random weighting of the image, by field.

    By opacities, harmonics and centres.
    """
    import drjit as dr

    random = torch.Generator().manual_seed(seed)
    weights = torch.randn(camera.height, camera.width, 3, generator=random)
    leaves = gaussians.map(lambda values: values.detach().clone().requires_grad_())
    (rasterize(leaves, camera).color * weights).sum().backward()
    scene = GaussianScene(mi, gaussians)
    names = {
        "opacities": "gaussians.opacities",
        "harmonics": "gaussians.sh_coeffs",
        "means": "gaussians.data",
    }
    for name in names.values():
        dr.enable_grad(scene.parameters[name])
    scene.parameters.update()
    scene.backpropagate(camera, weights)
    pairs = {}
    for name, theirs in names.items():
        ours = getattr(leaves, name).grad
        values = torch.from_numpy(np.array(dr.grad(scene.parameters[theirs]))).view(len(gaussians), -1)
        if name == "means":
            # By centres of the scene that is larger.
            values = values[:, :3] * _SCALE
        pairs[name] = ours, values.reshape(ours.shape)
    return pairs


def correlation_and_slope(ours: Float[Tensor, "..."], theirs: Float[Tensor, "..."]) -> tuple[float, float]:
    """Return the correlation of two gradients (about 0), and how much larger the second is."""
    product = (ours.double() * theirs.double()).sum()
    lengths = ours.double().norm() * theirs.double().norm()
    return float(product / lengths), float(product / ours.double().square().sum())


def _focal(camera: Camera) -> float:
    return float(camera.K.diagonal()[:2].max())


def _scale_translation(transform: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    larger = transform.clone()
    larger[:3, 3] *= _SCALE
    return larger


def _ellipsoid_mesh(mi: Any, gaussians: Gaussians) -> dict[str, Any]:
    def tensor(values: Tensor) -> Any:
        return mi.TensorXf(values.detach().contiguous().float().numpy())

    return {
        # Icospheres: the closed form misses small ones.
        "type": "ellipsoidsmesh",
        "centers": tensor(gaussians.means * _SCALE),
        "scales": tensor(gaussians.scales * _SCALE),
        # (x, y, z, w)
        "quaternions": tensor(gaussians.rotations[:, [1, 2, 3, 0]]),
        "opacities": tensor(gaussians.opacities[:, None]),
        "sh_coeffs": tensor(gaussians.harmonics.flatten(1)),
        "extent": EXTENT,
    }
