"""Gaussians traced by Mitsuba 3 (BSD): its `ellipsoids` shapes under the integrator `volprim_rf_basic`.

Rays, not splats: the image resembles ours, it is not the same. One sample per pixel; gradients of the
centres, scales, rotations, opacities and harmonics from Dr.Jit's adjoint pass.
"""

from typing import Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from dsar.geometry.cameras import world_from_camera
from dsar.types import Camera, Gaussians
from rivals import make_image_gradient

_LLVM_MIN = 19
mi.set_variant("llvm_ad_rgb")
if dr.detail.llvm_version()[0] < _LLVM_MIN:
    # With 15 and 16 the first kernel ends the whole process, with nothing to catch.
    raise ImportError(f"Dr.Jit needs libLLVM >= {_LLVM_MIN}, found {dr.detail.llvm_version()}")

_FIELDS = ("gaussians.data", "gaussians.opacities", "gaussians.sh_coeffs")
_COMPARED_SAMPLES = 16
"""Per pixel, for the image that is compared: one would be noise more than image."""


def prepare(
    gaussians: Gaussians, camera: Camera, threads: int, kind: Literal["ellipsoids", "ellipsoidsmesh"]
) -> "EllipsoidScene":
    """Return the scene as Mitsuba traces it."""
    dr.set_thread_count(threads)
    return EllipsoidScene(gaussians, camera, kind)


class EllipsoidScene:
    """A Mitsuba scene of Gaussians; every pass sets them anew, as a training step would."""

    def __init__(self, gaussians: Gaussians, camera: Camera, kind: str) -> None:
        # (x, y, z, w), and one row per Gaussian for everything.
        quaternions = gaussians.rotations[:, [1, 2, 3, 0]]
        shape = {
            "type": kind,
            "centers": _as_tensor(gaussians.means),
            "scales": _as_tensor(gaussians.scales),
            "quaternions": _as_tensor(quaternions),
            "opacities": _as_tensor(gaussians.opacities[:, None]),
            "sh_coeffs": _as_tensor(gaussians.harmonics.flatten(1)),
        }
        integrator = {"type": "volprim_rf_basic", "srgb_primitives": False}
        parts = {"integrator": integrator, "sensor": _describe_sensor(camera), "gaussians": shape}
        self._scene = mi.load_dict({"type": "scene", **parts})
        self._parameters = mi.traverse(self._scene)
        self._values = {name: np.array(self._parameters[name]) for name in _FIELDS}
        self._v_color = mi.TensorXf(make_image_gradient(camera).numpy())
        self._seed = 0

    def image(self) -> np.ndarray:
        """Return the colour image [h, w, 3]."""
        self._set(False)
        return np.array(mi.render(self._scene, spp=_COMPARED_SAMPLES))

    def forward(self) -> None:
        """Trace the image."""
        self._set(False)
        dr.eval(mi.render(self._scene, spp=1, seed=self._next_seed()))
        dr.sync_thread()

    def forward_backward(self) -> None:
        """Trace the image, and once more for the gradients."""
        self._set(True)
        seeds = {"seed": self._next_seed(), "seed_grad": self._next_seed()}
        image = mi.render(self._scene, self._parameters, spp=1, **seeds)
        dr.backward(dr.sum(image * self._v_color))
        dr.eval(*(dr.grad(self._parameters[name]) for name in _FIELDS))
        dr.sync_thread()

    def _set(self, with_gradients: bool) -> None:
        """Give the scene its Gaussians, which rebuilds what the rays search."""
        for name, values in self._values.items():
            self._parameters[name] = type(self._parameters[name])(values)
            if with_gradients:
                dr.enable_grad(self._parameters[name])
        self._parameters.update()

    def _next_seed(self) -> int:
        self._seed += 1
        return self._seed


def _describe_sensor(camera: Camera) -> dict:
    """Return Mitsuba's form of a camera with square pixels."""
    focal, (cx, cy) = camera.K[0, 0].item(), camera.K[:2, 2].tolist()
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height}
    return {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f(mi.ScalarMatrix4f(world_from_camera(camera, "mitsuba").tolist())),
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * focal)))),
        "principal_point_offset_x": 0.5 - cx / camera.width,
        "principal_point_offset_y": 0.5 - cy / camera.height,
        "near_clip": 0.01,
        "far_clip": 100.0,
        "film": film | {"rfilter": {"type": "box"}, "pixel_format": "rgb", "component_format": "float32"},
    }


def _as_tensor(values) -> mi.TensorXf:
    """Return a torch tensor's values as Mitsuba holds them."""
    return mi.TensorXf(values.detach().contiguous().numpy())
