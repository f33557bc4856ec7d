"""Parts of a dressed body."""

import dataclasses

import torch

from dsar.avatar.avatar import Avatar
from dsar.avatar.rollout import roll_out
from dsar.body.model import JOINT_NAMES
from dsar.config import TrainConfig
from dsar.data.captures.formats import open_capture
from dsar_render.labels import GARMENT, label_parts


def binding_of(figure, joints: tuple[str, ...], v: float = 0.5):
    """One Gaussian a joint, which moves it most."""
    count = len(joints)
    weights = 0.6 * torch.eye(count) + 0.4 / count
    return dataclasses.replace(
        figure.binding,
        joint_names=joints,
        weights=weights,
        uv=torch.tensor([[0.5, v]]).expand(count, 2),
        points=torch.zeros(count, 3),
        T_world_rest=torch.eye(4).expand(1, count, 4, 4),
    )


def part_of_each(figure, joints: tuple[str, ...], v: float = 0.5) -> list[str]:
    names, indices = label_parts(binding_of(figure, joints, v))
    assert len(set(names)) == len(names)
    return [names[index] for index in indices]


def test_parts_of_the_body_have_the_names_that_an_artist_expects(figure):
    expected = {
        "pelvis": "torso",
        "spine1": "torso",
        "spine3": "torso",
        "left_collar": "torso",
        "neck": "head",
        "head": "head",
        "jaw": "head",
        "left_eye_smplhf": "head",
        "left_shoulder": "left_arm",
        "right_elbow": "right_arm",
        "left_wrist": "left_hand",
        "right_index1": "right_hand",
        "left_thumb3": "left_hand",
        "left_hip": "left_leg",
        "right_knee": "right_leg",
        "left_ankle": "left_foot",
        "right_foot": "right_foot",
    }
    assert part_of_each(figure, tuple(expected)) == list(expected.values())


def test_every_joint_of_smplx_belongs_to_one_of_ten_parts(figure):
    sided = [f"{side}_{part}" for side in ("left", "right") for part in ("arm", "hand", "leg", "foot")]
    assert set(part_of_each(figure, JOINT_NAMES)) == {"head", "torso", *sided}


def test_a_joint_of_another_name_is_a_part_of_its_own(figure):
    assert part_of_each(figure, ("pelvis", "tail", "left_wing")) == ["torso", "tail", "left_wing"]


def test_a_joint_of_the_garments_name_shares_its_part(figure):
    assert part_of_each(figure, ("pelvis", "garment")) == ["torso", GARMENT]


def test_what_lies_below_the_bodys_chart_is_garment(figure):
    assert set(part_of_each(figure, ("head", "left_knee"), v=-0.01)) == {GARMENT}
    assert GARMENT not in part_of_each(figure, ("head", "left_knee"), v=0.0)


def test_left_and_right_hands_are_where_they_are(figure, labels):
    points = figure.binding.points
    middle = {name: points[labels.indices == index].mean(0) for index, name in enumerate(labels.names[:-1])}
    assert middle["left_hand"][0] > middle["left_arm"][0] > middle["torso"][0] > middle["right_arm"][0]
    assert middle["right_arm"][0] > middle["right_hand"][0]
    assert middle["head"][1] > middle["torso"][1] > middle["left_leg"][1] > middle["left_foot"][1]


def test_mattes_and_layers_agree_on_what_is_garment_and_what_is_beneath():
    torch.manual_seed(0)
    capture, config = open_capture("embedded"), TrainConfig()
    avatar = Avatar.from_capture(capture, capture.body, config.atlas, config.model)
    motion = capture.motions["sway"].slice(0, 1)
    names, indices = label_parts(roll_out(avatar, motion).binding)
    garment = torch.zeros(avatar.num_gaussians, dtype=torch.bool)
    garment[avatar.garment_texels()] = True
    assert torch.equal(indices == names.index(GARMENT), garment)
    assert not garment[avatar.texel_beneath].any()
    beneath = {names[index] for index in indices[avatar.texel_beneath].unique().tolist()}
    assert {"left_leg", "right_leg"} <= beneath <= {"left_leg", "right_leg", "torso"}
