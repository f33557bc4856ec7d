"""The body beneath a garment: its looks come from bare pixels, and nothing changes them afterwards."""

import dataclasses

import numpy as np
import pytest
import torch

from dsar.avatar.avatar import BORDER, Avatar
from dsar.avatar.garment_chart import tube_faces
from dsar.avatar.template import VISIBLE_LOGIT
from dsar.config import TrainConfig
from dsar.data.captures.formats import open_capture
from dsar.geometry.harmonics import color_from_harmonics
from dsar.network import NetworkOutput
from dsar.raster.mesh import rasterize_mesh
from dsar.training.chunk import ChunkTrainer
from dsar.training.draws import Draws
from dsar.training.kept_views import KeptViews
from dsar.training.layers import FRAMES, Layers, _pixels_away
from dsar.training.optimizers import keep_still, set_rates
from dsar.training.registered_maps import RegisteredMaps
from dsar.training.schedule import ScheduleState
from dsar.training.state import TrainingState
from dsar.training.workers import Gradients

SKIN, CLOTH = torch.tensor([0.8, 0.6, 0.5]), torch.tensor([0.1, 0.2, 0.9])
LATER = ScheduleState("autoregressive", 9, 2, 1e-3, 1e-2, 1.0)


@pytest.fixture(scope="module")
def capture():
    return open_capture("embedded")


@pytest.fixture
def avatar(capture):
    torch.manual_seed(0)
    config = TrainConfig()
    return Avatar.from_capture(capture, capture.body, config.atlas, config.model).train()


@pytest.fixture
def signals(capture, avatar):
    return {"sway": avatar.driving_signal(capture.motions["sway"])}


class PaintedViews:
    """A sequence's images in flat colours: cloth where it is said to be, skin elsewhere on the person."""

    def __init__(self, views, garment):
        self.views, self.garment, self.has = views, garment, views.has

    def read(self, camera, frame):
        image = self.views.read(camera, frame).copy()
        skin, cloth = (torch.stack([SKIN, CLOTH]) * 255).round().byte().numpy()
        image[..., :3] = np.where(self.garment(camera)[..., None], cloth, skin)
        return image


class LabelledPaint(PaintedViews):
    """The same with labels."""

    def garment_mask(self, camera, frame):
        return self.garment(camera)


def paint(capture, garment, views=PaintedViews):
    return dataclasses.replace(capture, views={"sway": views(capture.views["sway"], garment)})


def colors_of(avatar):
    return color_from_harmonics(
        avatar.template.harmonics.detach(), torch.tensor([[0.0, 0.0, 1.0]]).expand(avatar.num_gaussians, 3)
    )


def lifted_maps(avatar, lift):
    """Maps of one frame, the garment raised by some metres at its hem, and less above."""
    points = avatar.garment_control_points()
    heights = avatar.control.points[points, 1]
    share = (heights.max() - heights) / (heights.max() - heights.min())
    maps = RegisteredMaps({"sway": range(1)}, len(avatar.control.cells), {"sway": frozenset()})
    up = avatar.control.axes[points, 1]
    maps.offsets["sway"][0, points] = up * (lift * share)[:, None]
    maps.fitted["sway"] += 1
    return maps


def garment_in(avatar, signals, maps):
    """Return the function that says where a camera sees the garment of the first frame's map."""
    faces = tube_faces(len(avatar.garments[0].rows), avatar.atlas_size[1])
    offsets = maps.offsets["sway"][[0]][:, avatar.garment_control_points()]
    with torch.no_grad():
        posed = avatar.gaussians(signals["sway"].windows[[0]], avatar.offset_garment(offsets))[0]
    points = posed.means[avatar.garment_texels()].detach()
    return lambda camera: (rasterize_mesh(points, faces, camera).faces >= 0).numpy()


@pytest.mark.parametrize("labelled", [False, True], ids=["maps", "labels"])
def test_what_is_beneath_learns_from_bare_pixels_alone(capture, avatar, signals, labelled):
    hidden, maps = avatar.texel_hidden.clone(), lifted_maps(avatar, 0.25)
    painted = paint(capture, garment_in(avatar, signals, maps), LabelledPaint if labelled else PaintedViews)
    if labelled:
        maps = RegisteredMaps({}, len(avatar.control.cells), {})
    with torch.no_grad():
        avatar.template.harmonics.copy_(torch.full_like(avatar.template.harmonics, 2.0))
    Layers(KeptViews(painted), avatar, maps, signals, {"sway": range(1)}).settle()
    fixed, borrowed = avatar.texel_beneath, avatar.texel_borrowed
    assert fixed[hidden].all()
    assert not fixed[avatar.garment_texels()].any()
    assert 0 < avatar.borrowed_share < 0.8
    learnt = colors_of(avatar)[fixed & ~borrowed]
    assert len(learnt) > 100
    assert torch.allclose(learnt, SKIN.expand_as(learnt), atol=0.01), "a garment's colour came through"
    # What was not seen looks as something that was, or that no garment covers.
    known = {tuple(c) for c in avatar.template.harmonics[~(fixed & borrowed), 0].tolist()}
    assert {tuple(c) for c in avatar.template.harmonics[borrowed, 0].tolist()} <= known


def test_texels_that_only_a_moving_garment_covers_are_fixed_too(capture, avatar, signals):
    hidden, maps = avatar.texel_hidden.clone(), lifted_maps(avatar, -0.12)
    painted = paint(capture, garment_in(avatar, signals, maps))
    Layers(KeptViews(painted), avatar, maps, signals, {"sway": range(1)}).settle()
    extra = avatar.texel_beneath & ~hidden
    hem = avatar.texel_positions[avatar.garment_texels(), 1].min()
    assert extra.sum() > 30
    assert avatar.texel_positions[extra, 1].min() < hem - 0.05
    assert not (avatar.texel_beneath & (avatar.texel_positions[:, 0].abs() > 0.35)).any(), "an arm is fixed"


def test_without_maps_or_labels_the_nearest_skin_beyond_the_border_is_taken(capture, avatar, signals):
    hidden = avatar.texel_hidden.clone()
    points, count = avatar.texel_positions, avatar.num_gaussians
    with torch.no_grad():
        avatar.template.harmonics[:, 0] = torch.arange(count)[:, None].float()
    maps = RegisteredMaps({}, len(avatar.control.cells), {})
    Layers(KeptViews(capture), avatar, maps, signals, {"sway": range(1)}).settle()
    sources = avatar.template.harmonics[hidden, 0, 0].detach().long()
    assert not hidden[sources].any()
    assert torch.cdist(points[sources], points[hidden]).amin() > BORDER
    assert torch.equal(avatar.texel_beneath, hidden)
    assert avatar.borrowed_share == 1


def test_a_gaussian_that_strayed_from_the_body_comes_back(avatar):
    body = avatar.texels_on(avatar.charts[:1])
    here, there = body[:2].tolist()
    with torch.no_grad():
        avatar.template.means[here] += 0.005
        avatar.template.means[there] += 0.05
        avatar.template.log_scales[there] += 1.0
    shapes = avatar.template.log_scales.detach().clone()
    which = torch.zeros(avatar.num_gaussians, dtype=torch.bool)
    which[[here, there]] = True
    avatar.fix_looks(which, SKIN.expand(len(which), 3), which)
    assert torch.allclose(avatar.template.means[here], avatar.texel_positions[here] + 0.005)
    assert torch.equal(avatar.template.means[there], avatar.texel_positions[there])
    assert torch.allclose(avatar.template.log_scales[there], shapes[there] - 1.0, atol=1e-5)


def test_residuals_move_fixed_texels_and_do_not_change_their_looks(capture, avatar, signals):
    avatar.unhide_covered_texels()
    fixed, window = avatar.texel_beneath, signals["sway"].windows[[0]]
    shape = (1, 3 + avatar.model.appearance_channels, *avatar.control.size)
    values = 0.1 * torch.randn(shape, generator=torch.Generator().manual_seed(0))
    outputs = [NetworkOutput(v[:, :3], v[:, 3:], ()) for v in (torch.zeros(shape), values)]
    # Double precision takes the other path, tensor operation by operation.
    for kind in (torch.float32, torch.float64):
        model = avatar.to(kind)
        typed = (NetworkOutput(o.offset.to(kind), o.appearance.to(kind), ()) for o in outputs)
        still, moved = (model.gaussians(window.to(kind), output)[0] for output in typed)
        for name in ("rotations", "scales", "opacities", "harmonics"):
            before, after = getattr(still, name), getattr(moved, name)
            assert torch.equal(before[fixed], after[fixed]), name
            assert not torch.allclose(before[~fixed], after[~fixed]), name
        assert not torch.allclose(still.means[fixed], moved.means[fixed])


def test_images_never_reach_fixed_texels_and_momentum_does_not_move_them(capture, avatar, signals):
    state = TrainingState.begin(TrainConfig(), capture, avatar, {"sway": range(9)}, [("sway", 0)])
    trainer = ChunkTrainer(TrainConfig(), KeptViews(capture), state, signals, None)
    gradients = Gradients([*avatar.parameters(), *state.rest.parameters()])
    adam = state.optimizers["adam"]
    for seed in range(2):
        set_rates(state.optimizers, ScheduleState("template", 1, 2, 0.0, 0.0, 1.0))
        gradients.clear()
        trainer.backward_template(Draws(0, seed), 2)
        adam.step()
    maps = lifted_maps(avatar, -0.12)
    painted = paint(capture, garment_in(avatar, signals, maps))
    Layers(KeptViews(painted), avatar, maps, signals, {"sway": range(1)}).settle()
    keep_still(state.optimizers, avatar)
    fixed = avatar.texel_beneath
    before = {name: p.detach().clone() for name, p in avatar.template.named_parameters()}
    for seed in range(3):
        set_rates(state.optimizers, LATER)
        gradients.clear()
        trainer.backward_chunk(Draws(0, seed), LATER)
        for name, parameter in avatar.template.named_parameters():
            assert not parameter.grad[fixed].any(), name
        adam.step()
    for name, parameter in avatar.template.named_parameters():
        assert torch.equal(parameter[fixed], before[name][fixed]), f"{name} drifted"
        assert not torch.equal(parameter[~fixed], before[name][~fixed]), f"{name} learns nothing any more"
    assert (avatar.template.opacity_logits[fixed] >= VISIBLE_LOGIT).all()


def test_frames_are_spread_and_hold_those_with_the_garment_highest(capture, avatar):
    clips = {"sway": range(400)}
    maps = RegisteredMaps(clips, len(avatar.control.cells), {"sway": frozenset({120})})
    maps.fitted["sway"] += 300
    points = avatar.garment_control_points()
    maps.offsets["sway"][205:207, points] = avatar.control.axes[points, 1] * 0.3
    layers = Layers(KeptViews(capture), avatar, maps, {}, clips)
    frames = [frame for _, frame in layers.frames()]
    assert len(frames) == len(set(frames)) <= FRAMES
    assert {205, 206} & set(frames)
    assert 120 not in frames
    assert max(frames) < 300
    assert max(np.diff(sorted(frames))) < 15


def test_distances_to_a_mask_are_those_of_the_shortest_walk():
    mask = np.random.default_rng(0).random((40, 30)) > 0.99
    pixels = np.indices(mask.shape).reshape(2, -1, 1)
    rows, columns = np.abs(pixels - np.stack(np.nonzero(mask))[:, None])
    walks = np.maximum(rows, columns) + (np.sqrt(2) - 1) * np.minimum(rows, columns)
    assert np.allclose(_pixels_away(mask), walks.min(1).reshape(mask.shape), atol=1e-4)
