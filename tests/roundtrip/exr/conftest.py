"""Pictures of the figure, to be written."""

import dataclasses

import numpy as np
import pytest
from exr_files import PROVENANCE

from dsar.geometry.camera_paths import CameraPath
from dsar.geometry.cameras import look_at
from dsar.types import Camera, Picture
from dsar_render.aovs import AOVS
from dsar_render.labels import Labels, label_parts
from dsar_render.picture import render_picture
from dsar_render.settings import RenderSettings
from dsar_render.triplets import FrameTriplet, iterate_triplets


@pytest.fixture(scope="module")
def middle(figure) -> FrameTriplet:
    return next(iter(iterate_triplets(figure, {1003})))


@pytest.fixture(scope="module")
def labels(figure) -> Labels:
    """The body's parts, and a garment over its right half."""
    binding = figure.binding
    uv = binding.uv.clone()
    uv[binding.points[:, 0] < 0, 1] = -0.5
    names, indices = label_parts(dataclasses.replace(binding, uv=uv))
    return Labels(names, indices.numpy().astype(np.uint8))


@pytest.fixture(scope="module")
def take(middle, labels, front):
    """Return a function that takes pictures of the figure's middle frame."""

    def taken(
        camera: Camera = front, triplet: FrameTriplet = middle, fps: float = 24.0, **settings
    ) -> Picture:
        found = RenderSettings(**({"aovs": AOVS} | settings))
        path = CameraPath((camera,))
        return render_picture(triplet, path, found, labels=labels, fps=fps, provenance=PROVENANCE)

    return taken


@pytest.fixture(scope="module")
def picture(take) -> Picture:
    return take(deep=True)


@pytest.fixture(scope="module")
def wide(take) -> Picture:
    return take(deep=True, overscan=11)


@pytest.fixture(scope="module")
def side(front, take) -> Picture:
    """The same from another camera of the same size."""
    view = look_at(np.array([2.8, 0.4, 1.2]), np.array([0.0, -0.2, 0.0]))
    return take(dataclasses.replace(front, T_camera_world=view, name="side"), deep=True)


@pytest.fixture(scope="module")
def nothing(front, take) -> Picture:
    view = look_at(np.array([0.0, 0.0, 5.0]), np.array([0.0, 0.0, 9.0]))
    return take(dataclasses.replace(front, T_camera_world=view), deep=True)


@pytest.fixture
def small(front) -> Camera:
    return front.cropped(80, 80, 16, 12)
