"""Cameras over time: keys and what lies between, and those made around a moving person."""

import dataclasses
import math
import pickle

import numpy as np
import pytest
import torch

from dsar.body.files import load_body
from dsar.body.skinning import forward_kinematics, skin_points
from dsar.geometry.camera_paths import DOLLY, ORBIT, TURNTABLE, CameraPath, dolly, orbit, turntable
from dsar.geometry.cameras import look_at, project
from dsar.geometry.rotations import axis_angle_from_matrix
from dsar.types import Binding, Camera

FPS = 24.0
FRAMES = range(1001, 1049)
SIZES = {"portrait": (192, 256), "wide": (1920, 1080), "tall": (1080, 1920)}


def camera(angle: float, *, focal: float = 300.0, radius: float = 3.0) -> Camera:
    """A camera that looks at the origin from the side."""
    place = radius * np.array([math.sin(angle), 0.2, math.cos(angle)])
    K = torch.tensor([[focal, 0.0, 100.0], [0.0, focal, 130.0], [0.0, 0.0, 1.0]])
    return Camera(K, look_at(place, np.zeros(3)), 192, 256, "shot")


def keyed(*frames: int) -> CameraPath:
    cameras = (camera(0.1 * i * i, focal=300.0 + 7 * i, radius=3 + i) for i in range(len(frames)))
    return CameraPath(tuple(cameras), frames)


@pytest.fixture(scope="module")
def walk() -> Binding:
    """A body that turns, walks across, waves and jumps; at first it looks left of +Z."""
    body = load_body()
    t = torch.arange(len(FRAMES)) / FPS
    rotations, translations = torch.zeros(len(t), 55, 3), torch.zeros(len(t), 3)
    rotations[:, 16, 2], rotations[:, 17, 2] = -1.1 + torch.sin(6 * t), 1.1
    rotations[:, 0, 1] = 0.7 + 1.5 * t
    translations[:, 0], translations[:, 1] = 1.2 * t, 0.2 * torch.sin(5 * t).clamp_min(0)
    transforms = forward_kinematics(body, rotations, translations)
    names = tuple(f"joint{i}" for i in range(55))
    return Binding(body, names, body.vertices, body.weights, body.vertices[:, :2], transforms)


def skinned(binding: Binding, index: int) -> torch.Tensor:
    return skin_points(binding.points, binding.weights, binding.T_world_rest[index])


def within(view: Camera, points: torch.Tensor) -> torch.Tensor:
    """Return pixels as shares of the picture, all in front of the camera."""
    pixels, depth = project(view, points)
    assert (depth > 0).all()
    return pixels / torch.tensor([view.width, view.height])


def test_a_camera_at_rest_is_the_same_at_all_times():
    (view,) = (path := CameraPath((camera(0.3),))).cameras
    assert path.at(-5) is path.at(1001.25) is view
    assert path.around(7) is path
    assert path.name == "shot"


def test_at_a_key_the_camera_is_the_keyed_one_and_outside_the_nearest():
    path = keyed(1001, 1003, 1010)
    for index, frame in enumerate(path.frames):
        assert path.at(frame) is path.at(float(frame)) is path.cameras[index]
    assert path.at(900) is path.at(1000.99) is path.cameras[0]
    assert path.at(1010.01) is path.at(2000) is path.cameras[2]


@pytest.mark.parametrize("share", [0.001, 0.25, 0.5, 0.999])
def test_between_keys_centre_and_lens_go_straight_and_the_view_turns_evenly(share):
    path = keyed(1001, 1003, 1011)
    one, two = path.cameras[1:]
    found = path.at(1003 + 8 * share)
    assert torch.allclose(found.center, torch.lerp(one.center, two.center, share), atol=1e-6)
    assert torch.allclose(found.K, torch.lerp(one.K, two.K, share))
    turns = [view.T_camera_world[:3, :3].double() for view in (one, found, two)]
    angles = [axis_angle_from_matrix(turn @ turns[0].T) for turn in turns[1:]]
    assert torch.allclose(angles[0], share * angles[1], atol=1e-6)
    assert torch.allclose(turns[1] @ turns[1].T, torch.eye(3).double(), atol=1e-6)


def test_opposite_views_turn_by_the_short_way_and_close_ones_stay():
    one = camera(0.0)
    for angle in (1e-9, 1e-4, 3.1):
        path = CameraPath((one, camera(angle)), (0, 1))
        half = axis_angle_from_matrix(
            path.at(0.5).T_camera_world[:3, :3].double() @ one.T_camera_world[:3, :3].double().T
        )
        assert abs(float(half.norm()) - angle / 2) < 2e-3 * angle + 1e-6


@pytest.mark.parametrize("frames", [(1001, 1002, 1003, 1004, 1005), (1001, 1003, 1010, 1011, 1030)])
def test_the_part_around_a_frame_equals_the_path_to_the_bit(frames):
    path = keyed(*frames)
    for frame in range(frames[0] - 3, frames[-1] + 4):
        part = path.around(frame)
        assert len(part.cameras) <= 4
        for time in np.linspace(frame - 1, frame + 1, 23):
            whole, cut = path.at(float(time)), part.at(float(time))
            assert torch.equal(whole.K, cut.K)
            assert torch.equal(whole.T_camera_world, cut.T_camera_world)


def test_the_part_around_a_frame_of_a_film_is_small():
    film = keyed(*range(1001, 1501))
    assert len(pickle.dumps(film.around(1250))) < len(pickle.dumps(film)) / 50


def test_resized_views_see_the_same():
    path = keyed(1001, 1004)
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(0)) * 0.3
    larger = path.resized(1920, 1080)
    assert larger.frames == path.frames
    for time in (1001, 1002.5, 1004):
        seen, expected = within(larger.at(time), points), within(path.at(time), points)
        assert torch.allclose(seen, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("cameras", "frames", "message"),
    [
        ((), (), "at least one"),
        ((camera(0.0), camera(0.1)), (), "2 cameras has 0 frames"),
        ((camera(0.0),), (1, 2), "1 cameras has 2 frames"),
        ((camera(0.0), camera(0.1)), (2, 2), "do not ascend"),
        ((camera(0.0), dataclasses.replace(camera(0.1), name="other")), (1, 2), "one name and size"),
        ((camera(0.0), dataclasses.replace(camera(0.1), width=100)), (1, 2), "one name and size"),
    ],
)
def test_keys_that_make_no_camera_are_refused(cameras, frames, message):
    with pytest.raises(ValueError, match=message):
        CameraPath(cameras, frames)


@pytest.mark.parametrize("make", [turntable, orbit, dolly])
def test_made_cameras_are_keyed_at_the_motions_frames(make, walk):
    path = make(walk, FRAMES, FPS, width=64, height=48)
    assert path.frames == tuple(FRAMES)
    assert path.name in (TURNTABLE, ORBIT, DOLLY)
    assert (path.cameras[0].width, path.cameras[0].height) == (64, 48)
    for view in path.cameras:
        right, down = view.T_camera_world[0, :3], view.T_camera_world[1, :3]
        assert abs(float(right[1])) < 1e-6, "the horizon is level"
        assert down[1] < 0
    (still,) = make(
        dataclasses.replace(walk, T_world_rest=walk.T_world_rest[:1]), [1001], FPS, width=64, height=48
    ).cameras
    assert torch.isfinite(still.T_camera_world).all()


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_the_orbit_sees_the_whole_motion_from_all_sides_and_no_more_than_needed(walk, size):
    path = orbit(walk, FRAMES, FPS, width=size[0], height=size[1])
    everything = torch.cat([skinned(walk, index)[::7] for index in range(len(FRAMES))])
    # The eight seconds of a whole turn, of which the motion has but two.
    turn = orbit(
        dataclasses.replace(walk, T_world_rest=walk.T_world_rest.repeat(4, 1, 1, 1)),
        *(range(1001, 1193), FPS),
        width=size[0],
        height=size[1],
    )
    seen = torch.stack([within(turn.at(frame), everything) for frame in range(1001, 1193, 4)])
    assert 0.38 < (seen - 0.5).abs().max() < 0.48
    assert torch.allclose(turn.at(1001).center, path.at(1001).center, atol=1e-5)


def test_the_orbit_stands_on_a_circle_starts_in_front_and_turns_once_in_eight_seconds(walk):
    transforms = walk.T_world_rest.repeat(5, 1, 1, 1)
    path = orbit(
        dataclasses.replace(walk, T_world_rest=transforms), range(1001, 1241), FPS, width=64, height=64
    )
    places = torch.stack([view.center for view in path.cameras])
    middle = (places[0] + places[96]) / 2
    offsets = places - middle
    assert offsets[0, 2] > 2
    assert abs(float(offsets[0, 0])) < 1e-3
    assert offsets[48, 0] > 2
    assert torch.allclose(offsets.norm(dim=1), offsets.norm(dim=1)[:1].expand(240), atol=1e-3)
    assert torch.allclose(places[192], places[0], atol=1e-3)


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_the_dolly_goes_from_the_whole_body_to_head_and_shoulders(walk, size):
    path = dolly(walk, FRAMES, FPS, width=size[0], height=size[1])
    first = within(path.at(FRAMES[0]), skinned(walk, 0))
    assert 0 < first.min() < first.max() < 1
    assert (first.amax(0) - first.amin(0)).max() > 0.6
    rest = walk.body.vertices
    tall = float(rest[:, 1].max() - rest[:, 1].min())
    upper = rest[:, 1] > rest[:, 1].max() - 0.2 * tall
    torso = upper & (rest[:, 0].abs() < 0.12 * tall)
    last = within(path.at(FRAMES[-1]), skinned(walk, len(FRAMES) - 1))
    assert 0 < last[torso].min() < last[torso].max() < 1
    assert last[:, 1].max() > 1.5, "legs are below the picture"
    head = last[torso, 1]
    assert head.max() - head.min() > 0.2


def test_the_dolly_stands_before_the_person_and_sets_off_and_arrives_at_rest(walk):
    transforms = walk.T_world_rest[:1].expand(len(FRAMES), -1, -1, -1)
    path = dolly(dataclasses.replace(walk, T_world_rest=transforms), FRAMES, FPS, width=192, height=256)
    places = torch.stack([view.center for view in path.cameras])
    front = torch.tensor([math.sin(0.7), 0.0, math.cos(0.7)])
    pelvis = walk.T_world_rest[0, 0] @ torch.cat([walk.body.joints[0], torch.ones(1)])
    ahead = (places - pelvis[:3]) @ front
    assert torch.allclose((places - pelvis[:3])[:, [0, 2]], ahead[:, None] * front[[0, 2]], atol=1e-4)
    steps = -ahead.diff()
    assert (steps > 0).all()
    assert steps[0] < 0.15 * steps.max()
    assert steps[-1] < 0.15 * steps.max()


def test_the_dolly_leaves_small_steps_aside_and_follows_large_ones(walk):
    def sideways(reach: float) -> torch.Tensor:
        transforms = walk.T_world_rest[:1].repeat(len(FRAMES), 1, 1, 1)
        side = torch.tensor([math.cos(0.7), 0.0, -math.sin(0.7)])
        transforms[:, :, :3, 3] += reach * torch.linspace(0, 1, len(FRAMES))[:, None, None] * side
        moved = dataclasses.replace(walk, T_world_rest=transforms)
        path = dolly(moved, FRAMES, FPS, width=192, height=256)
        return torch.stack([view.center for view in path.cameras]) @ side

    still, small, large = (sideways(reach) for reach in (0.0, 0.03, 3.0))
    assert torch.allclose(small, still, atol=1e-5)
    assert 2.7 < large[-1] - still[-1] < 3.0
    assert large.diff().diff().abs().max() < 0.02, "nothing jerks"


def test_a_cameras_frame_is_the_same_whatever_else_is_rendered(walk):
    whole = turntable(walk, FRAMES, FPS, width=64, height=64)
    part = turntable(
        dataclasses.replace(walk, T_world_rest=walk.T_world_rest[10:12]),
        FRAMES[10:12],
        FPS,
        width=64,
        height=64,
    )
    assert torch.equal(whole.at(1011).T_camera_world, part.at(1011).T_camera_world)
