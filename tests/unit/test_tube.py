"""A garment's texels and the coarse grid of its simulation: means, fits and samples."""

import math

import pytest
import torch

from dsar.dynamics.tube import average_tube, fit_tube, places_down, sample_tube

GRID = (9, 24)
SIZES = [(17, 48), (64, 192), (9, 24), (8, 32)]


def even(height):
    return torch.linspace(0, GRID[0] - 1, height)


def uneven(height):
    return torch.linspace(0, 1, height).square() * (GRID[0] - 1)


def texels(places, width):
    down, columns = torch.meshgrid(places, torch.arange(width).float(), indexing="ij")
    return down.flatten(), columns.flatten()


def angles(columns):
    return (torch.arange(columns) + 0.5) / columns * 2 * math.pi


def cone(heights, width, radius=lambda y: 0.2 - 0.1 * y):
    around = angles(width)
    r = radius(heights)[:, None]
    return torch.stack([r * around.cos(), heights[:, None].expand(-1, width), r * around.sin()], -1)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("spread", [even, uneven])
def test_means_keep_constants_and_fits_keep_all_that_a_grid_can_say(size, spread):
    places = spread(size[0])
    torch.testing.assert_close(average_tube(torch.ones(*size, 1), places, GRID), torch.ones(*GRID, 1))
    torch.testing.assert_close(fit_tube(torch.ones(*size, 1), places, GRID), torch.ones(*GRID, 1))
    values = torch.rand(*GRID, 3, generator=torch.Generator().manual_seed(1))
    if min(size[0] / GRID[0], size[1] / GRID[1]) >= 2 and spread is even:
        sampling = sample_tube(*texels(places, size[1]), size[1], GRID)
        back = fit_tube(sampling(values.flatten(0, 1)).unflatten(0, size), places, GRID)
        # As far as the pull towards the means lets it.
        torch.testing.assert_close(back, values, atol=0.02, rtol=0)


@pytest.mark.parametrize("size", SIZES)
def test_a_fit_reaches_from_edge_to_edge_where_means_do_not(size):
    places = even(size[0])
    down = (places / (GRID[0] - 1))[:, None, None].expand(*size, 1)
    wanted = torch.linspace(0, 1, GRID[0])[:, None, None].expand(*GRID, 1)
    fitted, mean = fit_tube(down, places, GRID), average_tube(down, places, GRID)
    torch.testing.assert_close(fitted, wanted, atol=0.004, rtol=0)
    torch.testing.assert_close(mean[1:-1], wanted[1:-1], atol=0.02, rtol=0)
    if size[0] > GRID[0]:
        assert mean[-1].max() < 0.98


def test_no_grid_is_nearer_to_the_texels_than_the_fitted_one():
    generator = torch.Generator().manual_seed(2)
    places, values = uneven(33), torch.rand(33, 96, 2, generator=generator)
    sampling = sample_tube(*texels(places, 96), 96, GRID)
    fitted = fit_tube(values, places, GRID).flatten(0, 1)

    def error(grid):
        return (sampling(grid) - values.flatten(0, 1)).square().sum()

    least = error(fitted)
    assert least < error(average_tube(values, places, GRID).flatten(0, 1))
    for _ in range(20):
        step = 0.1 * torch.randn(fitted.shape, generator=generator)
        assert error(fitted + step) > least


def test_rows_lie_along_the_profile_and_crumpled_ones_take_no_place():
    heights = torch.linspace(0, -0.4, 25)
    crumpled = torch.cat([heights, -0.4 + 0.0005 * torch.arange(1, 8)])
    found = places_down(cone(crumpled, 48), GRID[0])
    assert (found.diff() > 0).all()
    assert found[0] == 0
    assert float(found[-1]) == pytest.approx(8)
    torch.testing.assert_close(found[:25], torch.linspace(0, 8, 25), atol=0.1, rtol=0)
    # The grid then has rows as far apart as on the cloth without them.
    rest = fit_tube(cone(crumpled, 48), found, GRID)
    steps = rest[..., 1].mean(1).diff()
    torch.testing.assert_close(steps, torch.full((8,), -0.05), atol=0.005, rtol=0)
    torch.testing.assert_close(places_down(torch.zeros(5, 8, 3), 3), torch.linspace(0, 2, 5))


def test_sampling_is_exact_for_what_is_linear_down_and_between_columns():
    places, width = even(33), 96
    down, columns = texels(places, width)
    inside = (columns > 4) & (columns < 91)
    sampling = sample_tube(down[inside], columns[inside], width, GRID)
    # A grid's column is in the middle of four texels'.
    along = ((torch.arange(GRID[1]) + 0.5) / GRID[1]).expand(GRID)
    rows = torch.arange(GRID[0]).float()[:, None].expand(GRID)
    found = sampling(torch.stack([rows, along], -1).flatten(0, 1))
    torch.testing.assert_close(found[:, 0], down[inside])
    torch.testing.assert_close(found[:, 1], (columns[inside] + 0.5) / width)
    torch.testing.assert_close(sampling.weights.sum(-1), torch.ones(int(inside.sum())))


def test_sampling_closes_around_the_seam():
    around = angles(GRID[1])
    values = torch.stack([around.sin(), around.cos()], -1).expand(*GRID, 2).flatten(0, 1)
    found = sample_tube(*texels(even(33), 96), 96, GRID)(values)
    angle = angles(96).repeat(33)
    # A chord is 1 - cos(half a column) inside its arc.
    assert (found - torch.stack([angle.sin(), angle.cos()], -1)).norm(dim=-1).max() < 0.009


@pytest.mark.parametrize("coarsen", [average_tube, fit_tube])
def test_a_turned_chart_has_the_turned_grid_and_samples(coarsen):
    places, values = uneven(33), torch.rand(33, 96, 3, generator=torch.Generator().manual_seed(0))
    coarse = coarsen(values, places, GRID)
    torch.testing.assert_close(coarsen(values.roll(4 * 5, 1), places, GRID), coarse.roll(5, 1))
    down, columns = texels(places, 96)
    one = sample_tube(down, columns, 96, GRID)(coarse.flatten(0, 1))
    two = sample_tube(down, (columns + 20) % 96, 96, GRID)(coarse.roll(5, 1).flatten(0, 1))
    torch.testing.assert_close(one, two)


def test_folds_survive_a_fit_and_get_shallow_in_means():
    places, angle = even(64), angles(192)
    values = (4 * angle).sin().expand(64, 192)[..., None]
    sampling = sample_tube(*texels(places, 192), 192, GRID)
    size = {
        coarsen: float(sampling(coarsen(values, places, GRID).flatten(0, 1)).std() / values.std())
        for coarsen in (average_tube, fit_tube)
    }
    assert size[fit_tube] > 0.98
    assert size[average_tube] < 0.8
