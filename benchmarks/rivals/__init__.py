"""The rasterisers that the benchmark compares, and how each one is called.

A rival's package is imported only when it is asked for, so that the benchmark runs without it.
"""

import importlib
import importlib.metadata
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from scene import make_image_gradient

from dsar.types import Camera, Gaussians


class Scene(Protocol):
    """Gaussians before a camera, ready to be drawn by one rasteriser.

    Every pass starts from the Gaussians' values: what a rasteriser builds from them counts.
    """

    def image(self) -> np.ndarray:
        """Return the colour image [h, w, 3], to be compared with other rasterisers'."""
        ...

    def forward(self) -> None:
        """Draw the image, without keeping what a backward pass needs."""
        ...

    def forward_backward(self) -> None:
        """Draw the image and compute the gradients of all five Gaussian fields."""
        ...


@dataclass(frozen=True)
class Rival:
    """One rasteriser and what there is to know about it before it is timed."""

    name: str
    """As in tables and charts."""
    about: str
    """What it is, and in what its work differs from ours."""
    module: str
    """Module in this package with `prepare(gaussians, camera, threads, **options) -> Scene`."""
    options: tuple[tuple[str, str], ...] = ()
    """Further arguments of `prepare`."""
    package: str | None = None
    """Distribution that must be installed."""
    bytes_per_pair: int = 0
    """Memory that forward + backward keeps for each pixel of a 16 x 16 tile and each Gaussian in it."""

    def is_installed(self) -> bool:
        """Tell whether the package it needs is here."""
        return self.package is None or importlib.util.find_spec(self.package.replace("-", "_")) is not None

    def version(self) -> str | None:
        """Return the version of the package it needs; None for those that need none."""
        return self.package and importlib.metadata.version(self.package)

    def prepare(self, gaussians: Gaussians, camera: Camera, threads: int) -> Scene:
        """Import the rasteriser and give it the Gaussians and the camera."""
        module = importlib.import_module(f"rivals.{self.module}")
        return module.prepare(gaussians, camera, threads, **dict(self.options))


class TorchScene:
    """A scene drawn by a function that autograd can differentiate."""

    def __init__(
        self, render: Callable[[Gaussians, Camera], torch.Tensor], gaussians: Gaussians, camera: Camera
    ) -> None:
        self._render, self._camera = render, camera
        self._gaussians = gaussians.map(lambda values: values.clone().requires_grad_())
        self._leaves = [getattr(self._gaussians, name) for name in vars(self._gaussians)]
        self._v_color = make_image_gradient(camera)

    def image(self) -> np.ndarray:
        """Return the colour image [h, w, 3]."""
        with torch.no_grad():
            return self._render(self._gaussians, self._camera).numpy()

    def forward(self) -> None:
        """Draw the image."""
        self.image()

    def forward_backward(self) -> None:
        """Draw the image and differentiate it by all fields."""
        torch.autograd.grad(self._render(self._gaussians, self._camera), self._leaves, self._v_color)


OURS = Rival(
    "cpu", "dsar.raster, Numba kernels with hand-written gradients", "dsar_raster", (("backend", "cpu"),)
)
RIVALS = (
    Rival(
        "torch tiles",
        "plain torch with autograd, written for this benchmark: sorted and binned once, one tile at a time; "
        "colour only, where ours also makes alpha and depth",
        "torch_tiles",
        bytes_per_pair=60,
    ),
    Rival(
        "reference",
        "dsar.raster, the plain torch oracle: every tile looks at every Gaussian",
        "dsar_raster",
        (("backend", "reference"),),
        bytes_per_pair=65,
    ),
    Rival(
        "metal-gauss",
        "metal_gauss.torch_ref with autograd: slabs of Gaussians per tile; Gaussians end at 3 sigma, "
        "pixels do not stop early",
        "metal_gauss",
        package="metal-gauss",
        bytes_per_pair=145,
    ),
    Rival(
        "mitsuba ellipsoids",
        "volprim_rf_basic traces one ray per pixel through analytic ellipsoids: another image (peak of each "
        "Gaussian along the ray, no dilation, order of entry), noisy gradients",
        "mitsuba_ellipsoids",
        (("kind", "ellipsoids"),),
        package="mitsuba",
    ),
    Rival(
        "mitsuba ellipsoidsmesh",
        "the same through triangle shells, rebuilt with every change of the Gaussians",
        "mitsuba_ellipsoids",
        (("kind", "ellipsoidsmesh"),),
        package="mitsuba",
    ),
)
NOT_COMPARED = {
    "litesplat 0.1.1": "multiplies the camera's and the Gaussians' rotations element by element and adds no "
    "dilation: its image is 14 dB from ours where black is 12; all pixels x all Gaussians, so 5000 at "
    "256 x 256 would keep over 16 GB",
    "taichi-splatting 0.13.0": "compiles CUDA sources when it is imported, and needs taichi-nightly",
    "gsplat 1.5.3, gswarp, splax, fvdb-core, INRIA's diff-gaussian-rasterization": "no CPU rasteriser",
    "gausscam 0.1.5": "no backward pass",
    "OpenSplat": "not on PyPI and without a Python interface",
}
"""Public rasterisers that were looked at, and why they are not timed."""
