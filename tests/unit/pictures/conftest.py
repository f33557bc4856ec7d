"""Frames of the figure, and cameras that see them."""

import dataclasses

import numpy as np
import pytest
import torch
from scenes import MIDDLE

from dsar.geometry.camera_paths import CameraPath
from dsar.geometry.cameras import look_at
from dsar.raster import rasterize
from dsar.types import Camera, Contributors, GaussianSequence, Picture
from dsar_render.aovs import AOVS
from dsar_render.labels import Labels, label_parts
from dsar_render.picture import render_picture
from dsar_render.settings import RenderSettings
from dsar_render.triplets import FrameTriplet, iterate_triplets


@pytest.fixture(scope="module")
def instants(figure: GaussianSequence) -> list[FrameTriplet]:
    return list(iterate_triplets(figure, figure.frame_numbers))


@pytest.fixture(scope="module")
def middle(instants: list[FrameTriplet]) -> FrameTriplet:
    return instants[MIDDLE]


@pytest.fixture(scope="module")
def labels(figure: GaussianSequence) -> Labels:
    names, indices = label_parts(figure.binding)
    return Labels(names, indices.numpy().astype(np.uint8))


@pytest.fixture(scope="module")
def still(front: Camera) -> CameraPath:
    return CameraPath((front,))


@pytest.fixture(scope="module")
def moving(front: Camera) -> CameraPath:
    """A camera that moves, turns and zooms in over the figure's frames, keyed at two of them."""
    K = torch.tensor([[320.0, 0.0, 95.0], [0.0, 320.0, 133.0], [0.0, 0.0, 1.0]])
    end = look_at(np.array([-0.4, 0.5, 2.9]), np.array([0.1, -0.2, 0.0]))
    return CameraPath((front, dataclasses.replace(front, K=K, T_camera_world=end)), (1001, 1006))


@pytest.fixture(scope="module")
def everything(middle: FrameTriplet, still: CameraPath, labels: Labels) -> Picture:
    return render_picture(middle, still, RenderSettings(AOVS), labels=labels)


@pytest.fixture(scope="module")
def blended(middle: FrameTriplet, front: Camera) -> Contributors:
    found = rasterize(middle.current, front, outputs=["contributors"]).contributors
    assert found is not None
    return found
