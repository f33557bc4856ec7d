"""What a file depends on, and what it does not."""

import dataclasses

import numba
import pytest
import torch
from scenes import layers

from dsar.geometry.camera_paths import CameraPath
from dsar.geometry.rotations import (
    matrix_from_axis_angle,
    quaternion_from_axis_angle,
    quaternion_multiply,
)
from dsar.types import Camera, Gaussians
from dsar_render.aovs import AOVS
from dsar_render.job_hash import hash_job
from dsar_render.picture import render_picture
from dsar_render.settings import RenderSettings
from dsar_render.triplets import FrameTriplet

PROVENANCE = {"checkpoint": "abc", "motion": "walk", "motion_hash": "12"}


def named(front: Camera, **changes) -> str:
    arguments = {
        "frame": 1003,
        "path": CameraPath((front,)),
        "settings": RenderSettings(("rgba", "Z")),
        "provenance": PROVENANCE,
        "writer": "exr",
    }
    return hash_job(**(arguments | changes))


def test_a_job_is_the_same_however_it_is_told(front):
    copy = dataclasses.replace(front, K=front.K.clone(), T_camera_world=front.T_camera_world.clone())
    again = named(
        copy, settings=RenderSettings(("rgba", "Z")), provenance=dict(reversed(list(PROVENANCE.items())))
    )
    assert again == named(front)
    assert len(again) == 32
    # Keys that say nothing new are no other path.
    assert named(front, path=CameraPath((front,) * 5, tuple(range(1001, 1006)))) == named(front)


def test_a_job_depends_on_everything_that_its_file_depends_on(front, moving):
    shifted, zoomed = front.T_camera_world.clone(), front.K.clone()
    shifted[0, 3] += 1e-6
    zoomed[0, 0] += 1e-4
    cameras = [
        dataclasses.replace(front, T_camera_world=shifted),
        dataclasses.replace(front, K=zoomed),
        dataclasses.replace(front, width=191),
        dataclasses.replace(front, height=255),
        dataclasses.replace(front, name="back"),
    ]
    # Where it is beside the frame makes motion vectors and blur.
    later = CameraPath((front, front, cameras[0]), (1000, 1003, 1004))
    earlier = CameraPath((cameras[0], front, front), (1002, 1003, 1004))
    settings = [
        {"aovs": ("rgba",)},
        {"aovs": ("Z", "rgba")},
        {"deep": True},
        {"deep_max_samples": 31},
        {"overscan": 1},
        {"shutter": (-0.25, 0.25)},
        {"shutter": (-0.25, 0.25), "motion_samples": 2},
    ]
    jobs = [
        named(front),
        named(front, frame=1004),
        named(front, path=moving),
        named(front, path=later),
        named(front, path=earlier),
        *(named(front, path=CameraPath((camera,))) for camera in cameras),
        *(named(front, settings=RenderSettings(**({"aovs": ("rgba", "Z")} | each))) for each in settings),
        *(named(front, provenance=PROVENANCE | {key: "other"}) for key in PROVENANCE),
        named(front, provenance=PROVENANCE | {"new": "abc"}),
        named(front, provenance={}),
        named(front, writer="png"),
    ]
    assert len(set(jobs)) == len(jobs)


def test_a_job_depends_on_the_version(front, monkeypatch):
    before = named(front)
    monkeypatch.setattr("dsar_render.job_hash._version", lambda: "9.9")
    assert named(front) != before


@pytest.mark.parametrize("settings", [{"deep": True}, {"motion_samples": 2, "shutter": (-0.25, 0.25)}])
def test_a_picture_does_not_depend_on_the_number_of_threads(middle, moving, labels, settings):
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one processor")
    before = numba.get_num_threads()
    pictures = []
    try:
        for threads in (1, numba.config.NUMBA_NUM_THREADS):
            numba.set_num_threads(threads)
            pictures.append(render_picture(middle, moving, RenderSettings(AOVS, **settings), labels=labels))
    finally:
        numba.set_num_threads(before)
    one, many = map(layers, pictures)
    assert all(torch.equal(one[name], many[name]) for name in one)
    if settings.get("deep"):
        deep = [vars(picture.deep) for picture in pictures]
        assert all(torch.equal(deep[0][name], deep[1][name]) for name in deep[0])


def test_a_picture_does_not_change_what_it_is_made_of(middle, still, labels):
    before = [values.clone() for values in vars(middle.current).values()]
    render_picture(middle, still, RenderSettings(AOVS, deep=True), labels=labels)
    assert all(map(torch.equal, before, vars(middle.current).values()))


def test_everything_follows_when_scene_and_camera_move_together(middle, moving, labels):
    turn, offset = torch.tensor([0.4, -0.8, 0.3]), torch.tensor([0.5, 1.5, -0.7])
    rotation, quaternion = matrix_from_axis_angle(turn), quaternion_from_axis_angle(turn)

    def carried(gaussians: Gaussians) -> Gaussians:
        rotations = quaternion_multiply(quaternion.expand(len(gaussians), 4), gaussians.rotations)
        return dataclasses.replace(
            gaussians, means=gaussians.means @ rotation.T + offset, rotations=rotations
        )

    def followed(camera: Camera) -> Camera:
        T_world_new = torch.eye(4, dtype=torch.float64)
        T_world_new[:3, :3], T_world_new[:3, 3] = rotation.T, -rotation.T @ offset
        return dataclasses.replace(
            camera, T_camera_world=(camera.T_camera_world.double() @ T_world_new).float()
        )

    elsewhere = FrameTriplet(middle.frame, *map(carried, (middle.current, middle.previous, middle.following)))
    path = dataclasses.replace(moving, cameras=tuple(map(followed, moving.cameras)))
    here = render_picture(middle, moving, RenderSettings(AOVS), labels=labels)
    there = render_picture(elsewhere, path, RenderSettings(AOVS), labels=labels)
    expected, found = layers(here), layers(there)
    hit = (here.output.alpha > 0.02) & (there.output.alpha > 0.02)
    expected["normals"] = expected["normals"] @ rotation.T
    expected["positions"] = expected["positions"] @ rotation.T + offset
    for name, image in expected.items():
        if name == "largest_weight_id":
            # Of two equal shares rounding makes either the larger.
            assert (image == found[name])[hit].float().mean() > 0.999
            continue
        difference = (found[name] - image)[hit].abs().flatten().sort().values
        assert difference[int(0.999 * (len(difference) - 1))] < 1e-4, name
        # Whether a fragment of just 1/255 is drawn hangs on the last digit.
        assert difference[-1] < 0.02, name
