"""The run-time checks of shapes are really on, and every module that is left out exists."""

import importlib

import pytest
import torch
from jaxtyping import TypeCheckError

from dsar.config import ModelConfig
from dsar.network.build import build_network
from dsar.raster import rasterize
from tests import type_checks


def test_wrong_shapes_are_refused_at_the_doors():
    network = build_network(ModelConfig(channels=(4, 8), heads=2), torch.ones(8, 8, dtype=torch.bool))
    with pytest.raises(TypeCheckError):
        network(torch.zeros(1, 3, 8), torch.zeros(1, 1, 8, 8), network.initial_state(1))
    with pytest.raises(TypeCheckError):
        rasterize("gaussians", "camera")


def test_what_is_not_checked_exists_and_is_reached_by_what_is():
    checked = set(type_checks.checked_modules())
    for name in type_checks.INNER:
        importlib.import_module(name)
    assert not checked & type_checks.INNER
    assert {"dsar.network.model", "dsar.network.session", "dsar.avatar.avatar", "dsar.raster"} <= checked
