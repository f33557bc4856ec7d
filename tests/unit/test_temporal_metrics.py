"""Change between frames: what a known motion must give."""

import dataclasses
from functools import partial

import pytest
import torch

from dsar.evaluation.image_metrics import flip
from dsar.evaluation.temporal_metrics import temporal_psnr, trace_back, warp_error
from dsar.evaluation.view_metrics import compare_change
from dsar.evaluation.views import View
from dsar.geometry.cameras import project
from dsar.raster import rasterize
from dsar.types import Camera, Gaussians

WHITE = torch.ones(3)
CAMERA = Camera(
    torch.tensor([[120.0, 0, 40], [0, 110.0, 32], [0, 0, 1]]), torch.eye(4), width=80, height=64, name="c"
)
TURN = torch.tensor([[0.98, 0.0, 0.199], [0.0, 1.0, 0.0], [-0.199, 0.0, 0.98]])


def wall(depth: float = 2.0, spacing: float = 0.01, half: tuple[int, int] = (20, 15)) -> Gaussians:
    """A smoothly coloured square wall that faces the camera."""
    columns, rows = torch.arange(-half[0], half[0] + 1), torch.arange(-half[1], half[1] + 1)
    x, y = torch.meshgrid(columns, rows, indexing="ij")
    means = torch.stack([spacing * x, spacing * y, torch.full_like(x, depth, dtype=torch.float)], -1)
    means = means.reshape(-1, 3).float()
    phase = means / (half[0] * spacing) * 4
    colors = 0.5 + 0.4 * torch.stack([phase[:, 0].sin(), phase[:, 1].cos(), phase.sum(1).sin()], 1)
    count = len(means)
    return Gaussians(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), spacing),
        torch.full((count,), 0.99),
        (colors[:, None] - 0.5) / 0.28209479,
    )


def draw(gaussians: Gaussians):
    return rasterize(gaussians, CAMERA, background=WHITE, outputs=("contributors",))


def measure(before: Gaussians, now: Gaussians) -> float | None:
    image = draw(now)
    return warp_error(draw(before), image, *trace_back(image, now, before, CAMERA))


def moved(gaussians: Gaussians, x: float, y: float = 0.0, z: float = 0.0) -> Gaussians:
    return dataclasses.replace(gaussians, means=gaussians.means + torch.tensor([x, y, z]))


@pytest.mark.parametrize("motion", [(0.0, 0.0), (0.05, 0.0), (0.031, -0.022), (0.0, 0.0, -0.1)])
def test_colours_that_stick_to_their_surface_have_no_warp_error(motion):
    before = wall()
    now = moved(before, *motion)
    assert measure(before, now) < 5e-5
    still = (draw(now).color - draw(before).color)[draw(now).alpha > 0.95].square().mean()
    if any(motion):
        assert still > 1e-3


def test_flicker_is_what_it_is_however_the_surface_moves():
    before = wall()
    lighter = dataclasses.replace(before, harmonics=before.harmonics + 0.1 / 0.28209479)
    for motion in ((0.0, 0.0), (0.05, 0.02)):
        assert measure(before, moved(lighter, *motion)) == pytest.approx(0.01, rel=0.02)


def test_what_was_hidden_does_not_count():
    """A curtain is drawn aside: the wall behind it is new and is not compared with it."""
    behind, curtain = wall(3.0, 0.02), wall(2.0, 0.012, (8, 20))
    red = dataclasses.replace(curtain, harmonics=torch.tensor([1.5, -1.5, -1.5]).expand(len(curtain), 1, 3))

    def both(front: Gaussians) -> Gaussians:
        fields = dataclasses.fields(Gaussians)
        parts = [torch.cat([getattr(behind, f.name), getattr(front, f.name)]) for f in fields]
        return Gaussians(*parts)

    before, now = both(red), both(moved(red, 0.1))
    image, last = draw(now), draw(before)
    back, depth = trace_back(image, now, before, CAMERA)
    error = warp_error(last, image, back, depth)
    # Without the test of depth the whole strip would be red against the wall's colours.
    careless = warp_error(last, image, back, last.depth * 0 + depth.new_tensor(2.0))
    assert error < 2e-3
    assert careless > 0.02


def test_motion_is_that_of_the_projected_centres():
    before = wall()
    now = dataclasses.replace(before, means=before.means @ TURN.T + torch.tensor([0.3, 0.0, 0.0]))
    one = now.map(lambda x: x[:1])
    back, depth = trace_back(draw(one), one, before.map(lambda x: x[:1]), CAMERA)
    (here, _), (there, z) = project(CAMERA, one.means), project(CAMERA, before.means[:1])
    hit = depth > 0
    assert hit.any()
    assert torch.allclose(back[hit], (there - here).expand(int(hit.sum()), 2), atol=1e-4)
    assert torch.allclose(depth[hit], z.expand(int(hit.sum())), atol=1e-5)


def test_nothing_in_view_has_no_warp_error():
    away = moved(wall(), 50.0)
    assert measure(away, away) is None


def test_temporal_psnr_is_blind_to_constant_errors_and_sees_changing_ones():
    generator = torch.Generator().manual_seed(0)
    first, second, blotch = (0.2 + 0.6 * torch.rand(9, 11, 3, generator=generator) for _ in range(3))
    wrong = 0.1 * blotch
    assert temporal_psnr((first + wrong, second + wrong), (first, second)) > 90
    assert temporal_psnr((first, second + 0.1), (first, second)) == pytest.approx(20, abs=0.01)
    # A frozen image misses all of the change.
    change = (second - first).square().mean()
    assert temporal_psnr((first, first), (first, second)) == pytest.approx(
        float(-10 * change.log10()), abs=1e-3
    )


def test_flip_is_zero_for_equal_images_one_for_black_against_white_and_sees_differences():
    pytest.importorskip("flip_evaluator")
    image = torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(0))
    assert flip(image, image) == 0
    black, white = torch.zeros(48, 64, 3), torch.ones(48, 64, 3)
    assert 0.9 < flip(black, white) <= 1
    small, large = flip((image + 0.02).clamp(0, 1), image), flip((image + 0.2).clamp(0, 1), image)
    assert 0 < small < large < 1


def test_tlpips_is_how_much_more_a_film_changes_than_it_should():
    def distance(image, truth):
        return float((image - truth).abs().mean())

    before, now = wall(), moved(wall(), 0.05)
    views = [View(draw(each).color, draw(each).alpha) for each in (before, now)]
    judge = partial(compare_change, (before, now), CAMERA, perceptual={"lpips": distance})
    assert judge((views[0], views[1]))["tlpips"] == pytest.approx(0, abs=1e-6)
    frozen = judge((views[0], views[0]))["tlpips"]
    assert frozen == pytest.approx(distance(views[0].color, views[1].color), rel=1e-4)
    assert frozen > 1e-3
