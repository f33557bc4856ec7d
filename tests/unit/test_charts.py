"""Charts: an avatar with a body and two garments, of which none knows anything of another."""

import math

import pytest
import torch

from dsar.avatar.avatar import Avatar
from dsar.avatar.charts import Atlas, Chart, ChartTexels, body_chart, decode_charts, encode_charts
from dsar.avatar.garment_chart import tube_tangents
from dsar.avatar.rollout import roll_out
from dsar.body.files import load_body
from dsar.body.uv_map import surface_frames
from dsar.config import ModelConfig
from dsar.types import Motion

WIDTH, UPSAMPLE = 32, 4
CHARTS = (
    Chart("body", "island", range(32)),
    Chart("skirt", "tube", range(32, 48)),
    Chart("shawl", "tube", range(48, 56)),
)


def tube(name: str, rows: int, top: float, bottom: float, radius: float) -> ChartTexels:
    """Return the chart of a cylinder around the pelvis, carried by it."""
    body = load_body()
    azimuths = (torch.arange(WIDTH) + 0.5) / WIDTH * 2 * math.pi - math.pi
    around = torch.stack([azimuths.sin(), torch.zeros(WIDTH), azimuths.cos()], -1)
    heights = torch.linspace(top, bottom, rows)[:, None, None] * torch.tensor([0.0, 1.0, 0.0])
    positions = body.joints[0] + radius * around + heights
    weights = torch.zeros(rows * WIDTH, 55)
    weights[:, 0] = 1
    frames = surface_frames(around.repeat(rows, 1))
    return ChartTexels(
        name,
        "tube",
        torch.ones(rows, WIDTH, dtype=torch.bool),
        positions.flatten(0, 1),
        weights,
        frames,
        tube_tangents(positions),
    )


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    torch.manual_seed(0)
    # The shawl begins where the skirt ends, so that their rows could be taken for neighbours.
    skirt, shawl = tube("skirt", 16, 0.0, -0.3, 0.25), tube("shawl", 8, -0.32, -0.45, 0.25)
    atlas = Atlas.stack([body_chart(load_body(), WIDTH), skirt, shawl])
    model = ModelConfig(channels=(8, 16), heads=2, window=3, memory=2, upsample=UPSAMPLE)
    made = Avatar(load_body(), atlas, model, 30.0)
    torch.nn.init.normal_(made.network.decoder.head.weight, std=0.2)
    return made.eval()


def chart_of(charts: tuple[Chart, ...], rows: torch.Tensor) -> torch.Tensor:
    """Return which chart each row is on."""
    return torch.stack([chart.holds(rows) for chart in charts]).int().argmax(0)


def test_charts_lie_below_one_another_and_hold_all_texels(avatar):
    assert avatar.charts == CHARTS
    assert avatar.garments == CHARTS[1:]
    counts = [len(avatar.texels_on([chart])) for chart in CHARTS]
    assert counts[1:] == [16 * WIDTH, 8 * WIDTH]
    assert sum(counts) == avatar.num_gaussians
    assert torch.equal(
        avatar.garment_texels(), torch.arange(avatar.num_gaussians - sum(counts[1:]), avatar.num_gaussians)
    )
    cells = (WIDTH // UPSAMPLE) ** 2
    assert avatar.garment_control_points().numel() == (16 + 8) // UPSAMPLE * WIDTH // UPSAMPLE
    assert avatar.control.cells[avatar.garment_control_points()].min() == cells


def test_nothing_is_sampled_across_charts(avatar):
    grid = avatar.control
    on = chart_of(avatar.charts, avatar.texels // WIDTH)
    indices, weights = grid.sampling
    sampled = chart_of(grid.charts, indices.long() // grid.size[1])
    assert (sampled == on[:, None]).all()
    assert torch.allclose(weights.sum(1), torch.ones(len(weights)))
    # A change of one chart's values is felt by its own texels, and by all of them.
    for number, chart in enumerate(grid.charts):
        maps = torch.zeros(1, 1, *grid.size)
        maps[:, :, chart.rows.start : chart.rows.stop] = 1.0
        values = (maps.flatten()[indices.long()] * weights).sum(1)
        assert torch.allclose(values, (on == number).float())


def test_edges_close_each_tube_and_link_no_two_charts(avatar):
    grid = avatar.control
    rows, columns = grid.cells // grid.size[1], grid.cells % grid.size[1]
    a, b = grid.edges.T
    assert torch.equal(chart_of(grid.charts, rows[a]), chart_of(grid.charts, rows[b]))
    wrapped = (columns[a] - columns[b]).abs() == grid.size[1] - 1
    assert not wrapped[rows[a] < grid.charts[0].rows.stop].any()
    for chart in grid.charts[1:]:
        inside, count = chart.holds(rows[a]), len(chart.rows)
        assert (wrapped & inside).sum() == count
        assert inside.sum() == count * grid.size[1] + (count - 1) * grid.size[1]


def test_an_offset_of_one_garment_moves_no_other_gaussian(avatar):
    signal = avatar.driving_signal(Motion(torch.zeros(1, 55, 3), torch.zeros(1, 3), 30.0))
    still = avatar.gaussians(signal.windows[[0]], None)[0].means
    points = avatar.garment_control_points()
    for chart, grid_chart in zip(avatar.garments, avatar.control.charts[1:], strict=True):
        offsets = torch.zeros(1, len(points), 3)
        offsets[:, grid_chart.holds(avatar.control.cells[points] // avatar.control.size[1])] = 0.1
        moved = avatar.gaussians(signal.windows[[0]], avatar.offset_garment(offsets))[0].means
        expected = torch.zeros(avatar.num_gaussians, dtype=torch.bool)
        expected[avatar.texels_on([chart])] = True
        assert torch.equal((moved - still).norm(dim=1) > 1e-3, expected)


def test_an_avatar_of_two_garments_rolls_out(avatar):
    rotations = torch.zeros(12, 55, 3)
    rotations[:, 0, 1] = 0.2 * torch.arange(12)
    frames = [g for _, g in roll_out(avatar, Motion(rotations, torch.zeros(12, 3), 30.0, "turn"))]
    assert len(frames) == 12
    for chart in avatar.charts:
        means = torch.stack([g.means[avatar.texels_on([chart])] for g in frames])
        assert means.isfinite().all()
        assert (means[-1] - means[0]).norm(dim=1).mean() > 0.05


def test_charts_survive_a_checkpoint_and_old_ones_follow_from_the_size():
    assert decode_charts(encode_charts(CHARTS), 56, WIDTH) == CHARTS
    assert decode_charts(None, 32, 32) == CHARTS[:1]
    assert decode_charts(None, 48, 32) == (CHARTS[0], Chart("garment", "tube", range(32, 48)))
    with pytest.raises(ValueError, match="of 48"):
        decode_charts(encode_charts(CHARTS), 48, WIDTH)
