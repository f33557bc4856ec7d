"""Driving a trained avatar with motion files: the same whichever way is up, faults said beforehand."""

import numpy as np
import pytest
import torch
from skeletons import LAFAN1, XSENS, world_joints, write_layout

from dsar.cli.export import Export
from dsar.data.motions.files import write_motion
from dsar.errors import ConfigError, MotionError


@pytest.fixture(scope="module")
def performance(trained):
    return Export(run_folder=trained, motion="test").open()


def written(path, motion, **changes):
    poses = motion.rotations.flatten(1).numpy()
    arrays = {"poses": poses, "trans": motion.translations.numpy(), "mocap_frame_rate": motion.fps}
    np.savez(path, **{key: value for key, value in (arrays | changes).items() if value is not None})
    return str(path)


def test_y_up_and_z_up_files_of_a_motion_give_the_same_gaussians(trained, performance, tmp_path):
    motion, body = performance.motion, performance.avatar.body
    write_motion(tmp_path / "z_up.npz", motion, body)
    files = [str(tmp_path / "z_up.npz"), written(tmp_path / "y_up.npz", motion)]
    rolls = [Export(run_folder=trained, motion=file).open().roll_out() for file in files]
    for (_, first), (_, second), (_, expected) in zip(*rolls, performance.roll_out(), strict=True):
        for gaussians in (first, second):
            assert torch.allclose(gaussians.means, expected.means, atol=1e-5)


@pytest.mark.parametrize("layout", [LAFAN1, XSENS], ids=["lafan1", "xsens"])
def test_a_bvh_drives_an_avatar_to_the_joints_of_the_motion_it_was_made_from(
    trained, performance, tmp_path, layout
):
    motion, body = performance.motion, performance.avatar.body
    path = write_layout(tmp_path / "clip.bvh", layout, body, motion)
    driven = Export(run_folder=trained, motion=str(path)).open().motion
    (_, places), (_, expected) = (world_joints(body, each) for each in (driven, motion))
    # The clip bends from its first frame on: nothing is taken for a rest pose.
    assert np.linalg.norm(places - expected, axis=-1)[:, :22].max() < 0.02


def test_flags_of_motion_files_are_read_and_refused_beside_a_sequence(trained, performance, tmp_path):
    path = written(tmp_path / "walk.npz", performance.motion, mocap_frame_rate=None)
    with pytest.raises(MotionError, match="say it with --motion-fps"):
        Export(run_folder=trained, motion=path).open()
    driven = Export(run_folder=trained, motion=path, up="y", motion_fps="30").open().motion
    assert torch.equal(driven.rotations, performance.motion.rotations)
    with pytest.raises(ConfigError, match="--up, --motion-fps: for motion files; bend is a sequence"):
        Export(run_folder=trained, motion="bend", up="y", motion_fps="30").open()


def test_a_figure_that_lies_is_noticed_before_anything_is_drawn(trained, performance, tmp_path, caplog):
    path = written(tmp_path / "walk.npz", performance.motion)
    Export(run_folder=trained, motion=path, up="z").open()
    assert "Motion walk: the figure lies; if it should stand, say --up y or --up z" in caplog.text
