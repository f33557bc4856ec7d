"""The garment chart on the embedded capture: found, in place, and able to carry what the images show."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.ndimage import minimum_filter

from dsar.avatar.avatar import Avatar
from dsar.avatar.garment_chart import loose_extent
from dsar.config import AtlasConfig, TrainConfig
from dsar.data.captures.formats import open_capture
from dsar.evaluation.garment_metrics import measure_garment
from dsar.raster import rasterize
from dsar.training.chunk import ChunkTrainer
from dsar.training.kept_views import KeptViews
from dsar.training.optimizers import set_rates
from dsar.training.schedule import ScheduleState
from dsar.training.state import TrainingState
from dsar.training.workers import Gradients


@pytest.fixture(scope="module")
def capture():
    return open_capture()


@pytest.fixture(scope="module")
def avatar(capture):
    torch.manual_seed(0)
    config = TrainConfig()
    return Avatar.from_capture(capture, capture.body, config.atlas, config.model)


def test_the_chart_spans_the_true_skirt_at_rest(capture, avatar):
    columns = AtlasConfig().resolution
    chart = avatar.template.means.detach()[-columns * AtlasConfig().garment_rows :]
    pelvis = avatar.driving_signal(capture.motions["sway"]).windows[0, 0, 0]
    world = (chart @ pelvis[:3, :3].T + pelvis[:3, 3]).numpy()
    truth = capture.garment("sway")[0]
    assert abs(world[:, 1].min() - truth[:, 1].min()) < 0.04
    # The hull cannot see where the skirt leaves the body: the waist may be a little low or high.
    assert abs(world[:, 1].max() - truth[:, 1].max()) < 0.12
    nearest = np.linalg.norm(truth[:, None] - world[None], axis=-1).min(1)
    assert np.median(nearest) < 0.03


def test_the_garments_figures_stand_between_the_template_s_and_the_truth_s(capture, avatar):
    found = measure_garment(avatar, capture, "near", 26)
    # An untrained network predicts its template.
    assert dataclasses.asdict(found["predicted"]) == pytest.approx(dataclasses.asdict(found["template"]))
    assert found["truth"].chamfer < 1e-4
    assert found["truth"].fscore == 1
    assert found["truth"].hem_radius == found["truth"].hem_height == 0
    assert 0 < found["second"].chamfer < 0.5 * found["template"].chamfer
    assert found["second"].jitter == pytest.approx(found["truth"].jitter, rel=0.2)


def test_links_close_the_tube_and_join_neither_charts_nor_islands(avatar):
    columns, rows = avatar.control.size[1], AtlasConfig().garment_rows // avatar.model.upsample
    row, column = avatar.control.cells // columns, avatar.control.cells % columns
    garment = row >= avatar.control.size[0] - rows
    a, b = avatar.control.edges.T
    assert torch.equal(garment[a], garment[b])
    seam = garment[a] & ((column[a] - column[b]).abs() == columns - 1)
    assert seam.sum() == rows
    # Around and down: every cell of the tube has its right neighbour and all but the last row the lower one.
    assert garment[a].sum() == rows * columns + (rows - 1) * columns
    step = (avatar.control.points[a] - avatar.control.points[b]).norm(dim=1)
    assert step.max() <= 2 * step.median() * 1.3


def test_the_body_beneath_is_hidden_at_first_then_looks_like_bare_skin(capture):
    torch.manual_seed(0)
    config = TrainConfig()
    avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model)
    hidden, template = avatar.texel_hidden.clone(), avatar.template
    body = avatar.texels < config.atlas.resolution**2
    heights = avatar.texel_positions[:, 1]
    assert 500 < hidden.sum() < 0.3 * body.sum()
    assert body[hidden].all()
    assert heights[hidden].min() > heights[~body].min() - 0.04
    assert heights[hidden].max() < heights[~body].max() + 0.01
    assert not hidden[avatar.texel_positions[:, 0].abs() > 0.35].any(), "an arm is hidden"
    assert template.opacity_logits[hidden].sigmoid().max() < 1 / 255
    with torch.no_grad():
        template.harmonics.copy_(torch.rand(avatar.num_gaussians, 1, 3))
    before = template.harmonics.detach().clone()
    avatar.unhide_covered_texels()
    assert torch.equal(template.harmonics[~hidden], before[~hidden])
    shown = template.harmonics[hidden][:, 0].detach()
    bare = before[body & ~hidden][:, 0]
    assert set(map(tuple, shown.tolist())) <= set(map(tuple, bare.tolist()))
    assert torch.equal(template.opacity_logits[hidden], template.opacity_logits[~hidden][: hidden.sum()])
    with torch.no_grad():
        template.harmonics.zero_()
    avatar.unhide_covered_texels()
    assert not template.harmonics.any(), "what has been learnt since was thrown away"


def test_the_network_trains_with_the_whole_body_the_template_without_what_is_beneath(capture):
    torch.manual_seed(0)
    config = TrainConfig()
    avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model).train()
    state = TrainingState.begin(config, capture, avatar, {"sway": range(3)}, [("sway", 0)])
    signals = {"sway": avatar.driving_signal(capture.motions["sway"])}
    trainer = ChunkTrainer(config, KeptViews(capture), state, signals, None)
    hidden = avatar.texel_hidden.clone()
    Gradients(list(avatar.parameters())).clear()
    trainer.backward_template(np.random.default_rng(0), 2)
    for name, parameter in avatar.template.named_parameters():
        assert parameter.grad[~hidden].any(), name
        assert not parameter.grad[hidden].any(), name
    trainer.backward_chunk(np.random.default_rng(0), ScheduleState("autoregressive", 9, 2, 0.0, 0.0, 0.0))
    assert not avatar.texel_hidden.any()
    assert avatar.template.opacity_logits[hidden].min() > 0


def test_a_tight_figure_gets_no_chart():
    heights = torch.linspace(-0.7, 0.3, 81)
    assert loose_extent(heights, torch.full((81,), 0.02)) is None
    skirt = torch.where((heights > -0.3) & (heights < 0.1), 0.1, 0.0)
    hem, waist = loose_extent(heights, skirt)
    assert hem == pytest.approx(-0.3, abs=0.02)
    assert waist == pytest.approx(0.1, abs=0.02)


@pytest.mark.parametrize(("sequence", "frame"), [("spin_left", 0), ("spin_left", 45)], ids=["rest", "spin"])
def test_one_fitted_frame_covers_the_mask(capture, sequence, frame):
    """Alpha recall, the measure of a garment that this avatar can carry.

    The solid inside of the mask must be covered; of the whole true alpha, soft border included, a little is
    lost to the rasteriser's blur of 0.3 pixels.
    """
    torch.manual_seed(0)
    config = TrainConfig()
    avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model).train()
    avatar.unhide_covered_texels()
    clips = {sequence: range(frame + 1)}
    state = TrainingState.begin(config, capture, avatar, clips, [(sequence, frame)])
    signals = {sequence: avatar.driving_signal(capture.motions[sequence])}
    trainer = ChunkTrainer(config, KeptViews(capture), state, signals, None)
    gradients = Gradients([*avatar.parameters(), *state.rest.parameters()])
    for step in range(110):
        reduction, factor = (2, 1.0) if step < 50 else (1, 0.5)
        set_rates(state.optimizers, ScheduleState("template", 1, reduction, 0.0, 0.0, factor))
        gradients.clear()
        trainer.backward_template(np.random.default_rng(step), reduction)
        state.optimizers["adam"].step()
    solid_recall, soft_recall = [], []
    with torch.no_grad():
        gaussians = avatar.gaussians(
            trainer.signals[sequence].windows[[frame]], state.rest.output(avatar, torch.tensor([0]))
        )[0]
        for index, camera in enumerate(capture.cameras):
            truth = torch.tensor(capture.image(sequence, frame, index)[..., 3]) / 255
            alpha = rasterize(gaussians, camera).alpha
            solid = torch.from_numpy(minimum_filter(truth.numpy(), 3) > 0.99)
            solid_recall.append(float(alpha[solid].mean()))
            soft_recall.append(float(torch.minimum(alpha, truth).sum() / truth.sum()))
    assert np.mean(solid_recall) >= 0.99
    assert np.mean(soft_recall) >= 0.97


def test_the_embedded_capture_is_what_a_test_of_memory_needs(capture):
    """One pose with two pasts: the cloth differs by more than 5 cm, and the body by nothing."""
    (pair,) = capture.one_to_many
    garment, motion = capture.garment(pair.sequence), capture.motions[pair.sequence]
    rest = sum(pair.at_rest) // 2
    after = range(pair.after_stop[0], pair.after_stop[1] + 1)
    for frame in after:
        assert torch.allclose(motion.rotations[frame], motion.rotations[rest], atol=1e-5)
        assert torch.allclose(motion.translations[frame], motion.translations[rest], atol=1e-5)
    apart = [np.sqrt(((garment[f] - garment[rest]) ** 2).sum(-1).mean()) for f in after]
    assert np.mean(apart[:15]) > 0.05
    # The floor: two true runs are far closer to each other than the held pose's two pasts.
    floor = np.sqrt(((capture.garment(pair.sequence, 1) - garment) ** 2).sum(-1).mean())
    assert floor < 0.3 * np.mean(apart[:15])
    assert sum(len(capture.motions[name]) for name in capture.splits["train"]) >= 700
    assert len(capture.splits["train"]) >= 6
