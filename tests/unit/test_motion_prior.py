"""The motion prior in an avatar: base of the offset, in players, mirrors and checkpoints, and its trust."""

import dataclasses

import pytest
import torch
from safetensors.torch import load, save

from dsar.avatar.avatar import Avatar
from dsar.avatar.charts import Atlas, body_chart
from dsar.avatar.mirror import Mirror, mirror_motion
from dsar.avatar.motion_prior import CHANNELS, GRID, REFERENCE_FPS, GarmentPrior
from dsar.avatar.player import Player
from dsar.avatar.rollout import network_outputs
from dsar.body.files import load_body
from dsar.config import PRESETS, ModelConfig
from dsar.dynamics.cloth import ClothConstants
from dsar.network import NetworkOutput
from dsar.types import Motion
from tests.loose_cloth import FPS, skirt_avatar, striding


def lively_avatar(seed: int = 3) -> Avatar:
    """Return an avatar with a motion prior whose network moves everything."""
    avatar = skirt_avatar(prior="cloth")
    torch.manual_seed(seed)
    torch.nn.init.normal_(avatar.network.decoder.head.weight, std=0.05)
    return avatar


def garment_of(avatar: Avatar) -> GarmentPrior:
    assert avatar.prior is not None
    (garment,) = avatar.prior.garments
    return garment


def cloth_of(avatar: Avatar, motion: Motion) -> torch.Tensor:
    cloth = avatar.driving_signal(motion).cloth
    assert cloth is not None
    return cloth


def offsets_of(avatar: Avatar, motion: Motion) -> torch.Tensor:
    return torch.cat([output.offset.clone() for _, output in network_outputs(avatar, motion)])


@pytest.fixture(scope="module")
def lively() -> Avatar:
    return lively_avatar()


@pytest.fixture(scope="module")
def walk() -> Motion:
    return striding(50, 1, "walk")


def test_the_prior_says_for_every_frame_where_the_garments_control_points_are(lively, walk):
    cloth = cloth_of(lively, walk)
    assert cloth.shape == (50, len(lively.garment_control_points()), CHANNELS)
    assert cloth[..., :3].norm(dim=-1).max() > 0.02
    assert torch.equal(cloth[0, :, 3:], torch.zeros_like(cloth[0, :, 3:]))
    torch.testing.assert_close(cloth[1:, :, 3:], cloth[..., :3].diff(dim=0))


def test_changes_are_per_thirtieth_of_a_second_at_any_rate(lively, walk):
    fast = dataclasses.replace(walk, fps=2 * REFERENCE_FPS)
    cloth = cloth_of(lively, fast)
    torch.testing.assert_close(cloth[1:, :, 3:], 2 * cloth[..., :3].diff(dim=0))


def test_control_points_move_as_the_grid_around_them(lively):
    garment = garment_of(lively)
    way = torch.tensor([0.01, -0.02, 0.03])
    along = garment.along_axes(way.expand(2, GRID[0] * GRID[1], 3))
    axes = lively.control.axes[lively.garment_control_points()]
    torch.testing.assert_close((axes @ along[1, :, :, None])[..., 0], way.expand(len(axes), 3))


@pytest.mark.parametrize("trust", [0.0, 0.4, 1.0])
def test_the_base_is_the_offset_as_far_as_it_is_trusted(lively, walk, trust):
    garment, cloth = garment_of(lively), cloth_of(lively, walk)
    kept = garment.trust.clone()
    garment.trust.fill_(trust)
    torch.testing.assert_close(lively.prior.base(cloth), trust * cloth[..., :3])
    maps = lively.offset_base(cloth)
    points = lively.gather_control_points(maps)
    on_garment = lively.garment_control_points()
    assert torch.equal(points[:, on_garment], lively.prior.base(cloth))
    points[:, on_garment] = 0
    assert not points.any()
    garment.trust.copy_(kept)


def test_trust_follows_the_rows(lively):
    garment = garment_of(lively)
    kept = garment.trust.clone()
    garment.trust.copy_(torch.linspace(0, 1, GRID[0]))
    shares = lively.prior.base(torch.ones(1, len(garment.axes), CHANNELS))[0, :, 0]
    heights = lively.control.points[lively.garment_control_points(), 1]
    down = (heights.max() - heights) / (heights.max() - heights.min())
    assert torch.corrcoef(torch.stack([shares, down]))[0, 1] > 0.999
    garment.trust.copy_(kept)


def test_an_output_stands_on_the_base(lively, walk):
    cloth = cloth_of(lively, walk)[:2]
    output = NetworkOutput(
        torch.randn(2, 3, *lively.control.size),
        torch.randn(2, lively.model.appearance_channels, *lively.control.size),
        (),
    )
    found = lively.add_prior(output, cloth)
    assert torch.equal(found.offset, output.offset + lively.offset_base(cloth))
    assert torch.equal(found.appearance, output.appearance)
    assert lively.add_prior(output, None) is output


def test_without_trust_the_network_is_left_alone(walk):
    avatar, doubting = lively_avatar(), lively_avatar()
    garment_of(doubting).trust.zero_()
    with torch.no_grad():
        trusted, alone = offsets_of(avatar, walk), offsets_of(doubting, walk)
    torch.testing.assert_close(trusted - alone, avatar.offset_base(cloth_of(avatar, walk)), atol=1e-6, rtol=0)
    # What the network sees of the prior is not a matter of trust.
    assert torch.equal(cloth_of(avatar, walk), cloth_of(doubting, walk))


def test_until_its_rest_shape_is_known_the_prior_is_zero(walk):
    avatar = lively_avatar()
    fresh = Avatar(avatar.body, avatar.atlas, avatar.model, FPS)
    assert not fresh.prior.placed
    assert not cloth_of(fresh, walk).any()
    fresh.place_prior()
    assert fresh.prior.placed


def test_training_steps_and_players_make_the_same_offsets(lively, walk):
    signal, state, found = lively.driving_signal(walk), lively.initial_state(), []
    with torch.no_grad():
        for frame in range(20):
            window, cloth = signal.windows[[frame]], signal.cloth_at([frame])
            output, state, _ = lively.forward_frame(window, state, cloth)
            found.append(output.offset)
    torch.testing.assert_close(torch.cat(found), offsets_of(lively, walk)[:20], atol=1e-5, rtol=0)


def test_frames_are_the_same_to_the_bit_whichever_were_played_before(lively):
    signal = lively.driving_signal(striding(80, 2, "walk"))
    player = Player(lively, signal)
    frames = [player.step().gaussians.means for _ in range(80)]
    assert (frames[60] - frames[0]).abs().max() > 0.01
    for frame in (70, 10, 45, 0, 79, 31):
        player.seek(frame)
        assert torch.equal(player.step().gaussians.means, frames[frame])
    late = Player(lively, signal)
    late.seek(66)
    assert torch.equal(late.step().gaussians.means, frames[66])


def test_what_comes_later_changes_nothing_before(lively, walk):
    whole, cut = offsets_of(lively, walk), offsets_of(lively, walk.slice(0, 30))
    assert torch.equal(whole[:30], cut)


# The mirror.


def test_mirroring_twice_is_not_mirroring(lively, walk):
    mirror, cloth = Mirror(lively.control), cloth_of(lively, walk)
    every = torch.ones(len(cloth), dtype=torch.bool)
    once = mirror.mirror_cloth(cloth, every)
    assert (once - cloth).abs().max() > 0.005
    torch.testing.assert_close(mirror.mirror_cloth(once, every), cloth, atol=1e-6, rtol=0)
    some = every.clone()
    some[::2] = False
    mixed = mirror.mirror_cloth(cloth, some)
    assert torch.equal(mixed[::2], cloth[::2])
    assert torch.equal(mixed[1::2], once[1::2])


def test_offsets_of_the_prior_are_mirrored_as_the_networks_are(lively, walk):
    mirror, cloth = Mirror(lively.control), cloth_of(lively, walk)
    every = torch.ones(len(cloth), dtype=torch.bool)
    maps = lively.control.scatter(lively.scatter_garment_points(cloth[..., :3]))
    expected = lively.gather_control_points(mirror.mirror_offset(maps))[:, lively.garment_control_points()]
    torch.testing.assert_close(mirror.mirror_cloth(cloth, every)[..., :3], expected)


def test_cloth_of_the_mirrored_motion_is_nearly_the_mirrored_cloth(lively, walk):
    signal = lively.driving_signal(walk)
    mirrored = lively.prior.simulate(lively.body, mirror_motion(signal.steady), FPS)[..., :3]
    every = torch.ones(len(walk), dtype=torch.bool)
    expected = Mirror(lively.control).mirror_cloth(signal.cloth, every)[..., :3]
    size = signal.cloth[..., :3].norm(dim=-1).mean()
    # Body and collider are symmetric to a centimetre only, and the sweep has its direction around.
    assert (mirrored - expected).norm(dim=-1).mean() < 0.4 * size
    assert (mirrored - signal.cloth[..., :3]).norm(dim=-1).mean() > 0.6 * size


# Models with it and without.


def test_checkpoints_give_the_same_cloth_to_the_bit(walk):
    avatar = lively_avatar()
    garment = garment_of(avatar)
    constants = dataclasses.replace(ClothConstants(), drag=5.0, pull=7.0)
    garment.constants.copy_(torch.from_numpy(constants.to_vector()))
    garment.hanging.normal_(0, 0.003)
    garment.trust.uniform_(0, 1)
    content = load(save(avatar.state_dict()))
    # One that has simulated another garment before.
    other = lively_avatar(7)
    with torch.no_grad():
        other.template.means.mul_(0.8)
    other.place_prior()
    assert not torch.equal(cloth_of(other, walk), cloth_of(avatar, walk))
    fresh = Avatar(avatar.body, avatar.atlas, avatar.model, FPS).eval()
    for loaded in (fresh, other):
        loaded.load_state_dict(content)
        assert torch.equal(cloth_of(loaded, walk), cloth_of(avatar, walk))
        assert torch.equal(offsets_of(loaded, walk), offsets_of(avatar, walk))


def test_a_person_without_loose_clothes_has_no_prior_and_no_channels_for_it():
    body = load_body()
    usual = ModelConfig(channels=(4, 8), heads=2, upsample=2)
    assert usual.prior == "cloth"
    bare = Avatar(body, Atlas.stack([body_chart(body, 32)]), usual, FPS)
    assert bare.prior is None
    assert bare.model == dataclasses.replace(usual, prior="none")
    assert bare.network.encoder.pyramid.first.weight.shape[1] == bare.model.map_channels + 3 + 8
    assert bare.driving_signal(striding(5, 1, "walk")).cloth is None
    assert not any(name.startswith("prior.") for name in bare.state_dict())
    assert len(offsets_of(bare.eval(), striding(5, 1, "walk"))) == 5


def test_the_prior_learns_nothing_and_leaves_the_template_as_it_is():
    one, two = skirt_avatar(prior="cloth"), skirt_avatar(prior="none")
    parameters = [dict(avatar.named_parameters()) for avatar in (one, two)]
    assert parameters[0].keys() == parameters[1].keys()
    others = [name for name, values in parameters[0].items() if values.shape != parameters[1][name].shape]
    assert others == ["network.encoder.pyramid.first.weight"]
    assert one.model.map_channels == two.model.map_channels + CHANNELS
    motion = striding(2, 1, "walk")
    posed = [avatar.gaussians(avatar.driving_signal(motion).windows, None)[1] for avatar in (one, two)]
    assert posed[0].means.shape == posed[1].means.shape
    assert two.driving_signal(motion).cloth is None


def test_the_papers_preset_has_no_prior():
    assert PRESETS["paper"].model.prior == "none"
    assert PRESETS["demo"].model.prior == "cloth"
