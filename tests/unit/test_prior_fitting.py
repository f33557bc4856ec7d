"""What kind of cloth registered maps show: found where a simulation made them, else not trusted."""

import dataclasses

import pytest
import torch
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.motion_prior import GRID, hang
from dsar.dynamics.cloth import ClothConstants
from dsar.training import prior_fitting
from dsar.training.prior_fitting import constants_at, fit_prior
from dsar.training.registered_maps import RegisteredMaps
from tests.loose_cloth import FPS, skirt_avatar, striding

FRAMES = 45
MOTIONS = {name: striding(FRAMES, seed, name) for seed, name in enumerate(("one", "two", "unseen"))}
TRAINING = ("one", "two")
STILL = [("one", 0)]
HELD = dataclasses.replace(ClothConstants(), drag=2.5, pull=40.0, homing=1.5)
"""Cloth that swings less, and shorter, than the usual."""


@pytest.fixture(scope="module", autouse=True)
def _short_search():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prior_fitting, "GENERATIONS", 10)
        patch.setattr(prior_fitting, "POPULATION", 6)
        yield


def garment_of(avatar: Avatar):
    assert avatar.prior is not None
    (garment,) = avatar.prior.garments
    return garment


def offsets_of(avatar: Avatar) -> dict[str, Tensor]:
    """Return the simulated offsets at the garment's control points, by motion."""
    found = {}
    for name, motion in MOTIONS.items():
        cloth = avatar.driving_signal(motion).cloth
        assert cloth is not None
        found[name] = cloth[..., :3]
    return found


def trusts_of(avatar: Avatar) -> Tensor:
    """Return how far the prior is trusted at each control point of the garment."""
    garment = garment_of(avatar)
    return garment.sampling(garment.trust.repeat_interleave(GRID[1])[:, None])


def bases_of(avatar: Avatar) -> dict[str, Tensor]:
    return {name: avatar.prior.base(avatar.driving_signal(motion).cloth) for name, motion in MOTIONS.items()}


@pytest.fixture(scope="module")
def made() -> dict[str, Tensor]:
    """Return maps that a simulation with known constants has made."""
    avatar = skirt_avatar(prior="cloth")
    garment = garment_of(avatar)
    garment.constants.copy_(torch.from_numpy(HELD.to_vector()))
    simulation = garment.simulation(avatar.body)
    stages = [simulation.stage(avatar.driving_signal(MOTIONS[name]).steady[[frame]]) for name, frame in STILL]
    garment.hanging.copy_(hang(simulation, simulation.fabric(HELD), stages, FPS))
    return offsets_of(avatar)


def fitted(offsets: dict[str, Tensor], frames: int = FRAMES) -> Avatar:
    """Return an avatar whose prior was fitted to some offsets of the training motions."""
    avatar = skirt_avatar(prior="cloth")
    maps = RegisteredMaps({name: range(FRAMES) for name in TRAINING}, len(avatar.control.cells), {})
    for name in TRAINING:
        maps.offsets[name] = avatar.scatter_garment_points(offsets[name])
        maps.fitted[name].fill_(frames)
    fit_prior(avatar, maps, {name: avatar.driving_signal(MOTIONS[name]) for name in TRAINING}, STILL, seed=0)
    return avatar


def error(found: dict[str, Tensor], target: dict[str, Tensor], names=TRAINING) -> float:
    """Return the mean distance, metres."""
    return float(torch.stack([(found[name] - target[name]).norm(dim=-1).mean() for name in names]).mean())


def nothing(target: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: torch.zeros_like(offsets) for name, offsets in target.items()}


@pytest.fixture(scope="module")
def found(made) -> Avatar:
    return fitted(made)


def test_the_cloth_of_simulated_maps_is_found_and_trusted(made, found):
    usual = fitted(made, frames=0)
    assert torch.equal(garment_of(usual).constants, torch.from_numpy(ClothConstants().to_vector()))
    before, after = error(offsets_of(usual), made), error(offsets_of(found), made)
    assert before > 0.003
    assert after < 0.8 * before
    # And on a motion that the search has not seen.
    assert error(offsets_of(found), made, ("unseen",)) < error(offsets_of(usual), made, ("unseen",))
    assert trusts_of(found).min() > 0.8
    assert error(bases_of(found), made) < 0.4 * error(nothing(made), made)


def test_the_search_comes_to_the_same_cloth_again(made, found):
    one, two = garment_of(found), garment_of(fitted(made))
    for name in ("constants", "trust", "hanging"):
        assert torch.equal(getattr(one, name), getattr(two, name))


def test_without_maps_usual_cloth_is_trusted_and_hangs_as_it_hangs(made):
    garment = garment_of(fitted(made, frames=0))
    assert torch.equal(garment.trust, torch.ones(GRID[0]))
    assert garment.hanging.norm(dim=-1).max() > 1e-3


def test_noise_is_not_explained(made):
    generator = torch.Generator().manual_seed(0)
    noise = {name: 0.03 * torch.randn(maps.shape, generator=generator) for name, maps in made.items()}
    avatar = fitted(noise)
    assert error(bases_of(avatar), noise) < 1.02 * error(nothing(noise), noise)
    assert torch.cat([*bases_of(avatar).values()]).norm(dim=-1).mean() < 0.01


def test_where_the_prior_is_wrong_the_base_is_hardly_worse_than_the_template(made):
    wrong = {name: -maps for name, maps in made.items()}
    avatar = fitted(wrong)
    assert trusts_of(avatar).max() < 0.2
    for names in (TRAINING, ("unseen",)):
        assert error(bases_of(avatar), wrong, names) < 1.05 * error(nothing(wrong), wrong, names)


def test_constants_lie_around_the_usual_ones_and_within_their_limits():
    usual = ClothConstants()
    assert constants_at(0 * usual.to_vector()).to_vector() == pytest.approx(usual.to_vector())
    wild = constants_at(100 + 0 * usual.to_vector())
    for name, limit in prior_fitting.LIMITS.items():
        assert getattr(wild, name) == limit
    small = constants_at(-100 + 0 * usual.to_vector())
    for name in prior_fitting.WIDTHS:
        assert getattr(small, name) == pytest.approx(1, abs=1e-3)
    assert min(small.to_vector()) >= 0
