"""The native capture reader, on a small capture made here and on the embedded one."""

import json
import pickle
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from dsar.body.files import load_body
from dsar.body.skinning import forward_kinematics
from dsar.data.captures.formats import EMBEDDED_CAPTURE, open_capture
from dsar.data.motions.files import write_motion
from dsar.errors import CaptureError, ConfigError
from dsar.geometry.cameras import look_at, project
from dsar.types import Motion

FRAMES, WIDTH, HEIGHT = 3, 12, 16


def _image(camera: int, frame: int) -> np.ndarray:
    rng = np.random.default_rng(10 * camera + frame)
    return rng.integers(0, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)


@pytest.fixture
def folder(template: Path, tmp_path: Path) -> Path:
    """A valid capture to spoil."""
    return shutil.copytree(template, tmp_path / "capture")


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A valid capture of two cameras and one sequence, with PNG images in a folder."""
    tmp_path = tmp_path_factory.mktemp("template")
    body = load_body()
    generator = torch.Generator().manual_seed(0)
    motion = Motion(0.2 * torch.randn(FRAMES, 55, 3, generator=generator), torch.zeros(FRAMES, 3), 30.0)
    write_motion(tmp_path / "walk.npz", motion, body)
    cameras = []
    for k, position in enumerate(([0.0, 1.0, 3.0], [3.0, 1.0, 0.0])):
        (tmp_path / f"walk/cam{k}").mkdir(parents=True)
        for frame in range(FRAMES):
            Image.fromarray(_image(k, frame)).save(tmp_path / f"walk/cam{k}/{frame:04d}.png")
        transform = look_at(np.array(position), np.array([0.0, 1.0, 0.0])).double().tolist()
        K = [[20.0, 0.0, 6.0], [0.0, 20.0, 8.0], [0.0, 0.0, 1.0]]
        cameras.append(
            {"name": f"cam{k}", "K": K, "T_camera_world": transform, "width": WIDTH, "height": HEIGHT}
        )
    truth = np.array([[[100, 200, 300]], [[1, 0, 0]], [[0, -2, 0]]], np.int16)
    np.savez(
        tmp_path / "garment.npz", run0=truth, unit=np.float64(0.001), faces=np.array([[0, 0, 0]], np.int32)
    )
    record = {
        "format": "dsar-capture", "version": 1, "name": "tiny", "fps": 30.0, "cameras": cameras,
        "body": None, "betas": [],
        "sequences": {"walk": {
            "motion": "walk.npz", "images": "walk", "frames": FRAMES, "split": "test", "labels": ["nd"],
            "garment": "garment.npz",
        }},
        "one_to_many": [{"sequence": "walk", "after_stop": [1, 2], "at_rest": [0, 0]}],
    }  # fmt: skip
    (tmp_path / "capture.json").write_text(json.dumps(record))
    return tmp_path


def _edit(folder: Path, *path: str | int, value: object) -> None:
    record = json.loads((folder / "capture.json").read_text())
    target = record
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    (folder / "capture.json").write_text(json.dumps(record))


def test_png_images_come_back_bit_for_bit(folder):
    capture = open_capture(folder)
    for camera in range(2):
        for frame in range(FRAMES):
            np.testing.assert_array_equal(capture.image("walk", frame, camera), _image(camera, frame))


def test_zip_and_folder_give_the_same_images(folder):
    expected = open_capture(folder).image("walk", 1, 1)
    with zipfile.ZipFile(folder / "walk.zip", "w") as archive:
        for path in sorted((folder / "walk").glob("*/*")):
            archive.write(path, path.relative_to(folder / "walk").as_posix())
    _edit(folder, "sequences", "walk", "images", value="walk.zip")
    np.testing.assert_array_equal(open_capture(folder).image("walk", 1, 1), expected)


def test_record_fields_arrive(folder):
    capture = open_capture(folder)
    assert [camera.name for camera in capture.cameras] == ["cam0", "cam1"]
    assert capture.splits == {"train": (), "test": ("walk",), "nd": ("walk",)}
    assert len(capture.motions["walk"]) == FRAMES
    assert capture.motions["walk"].name == "walk"
    assert (capture.one_to_many[0].after_stop, capture.one_to_many[0].at_rest) == ((1, 2), (0, 0))


def test_garment_is_the_running_sum_of_its_steps(folder):
    garment = open_capture(folder).garment("walk")
    expected = np.array([[[0.1, 0.2, 0.3]], [[0.101, 0.2, 0.3]], [[0.101, 0.198, 0.3]]], np.float32)
    np.testing.assert_array_equal(garment, expected)


def test_pickling_sends_a_path_and_no_images(folder):
    capture = open_capture(folder)
    capture.image("walk", 0, 0)
    data = pickle.dumps(capture)
    assert len(data) < 500
    np.testing.assert_array_equal(pickle.loads(data).image("walk", 2, 1), _image(1, 2))


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("format",), "other", "expected format 'dsar-capture' version 1, found 'other'"),
        (("version",), 2, "version 1, found 'dsar-capture' version 2"),
        (("cameras",), [], "at least one camera"),
        (("cameras", 0, "name"), "cam1", "names that differ"),
        (("cameras", 0, "name"), "front left", "letters, digits"),
        (("cameras", 0, "K", 0, 0), -1.0, "expected K as"),
        (("cameras", 1, "T_camera_world", 0, 0), 2.0, "cam1: expected T_camera_world as a rotation"),
        (("cameras", 1, "T_camera_world"), [[1, 0], [0, 1]], "expected T_camera_world as a 4x4 list"),
        (
            ("cameras", 0, "width"),
            13,
            "cam0/0000.png.*expected 13x16 pixels as camera cam0.*found 12x16",
        ),
        (("sequences", "walk", "frames"), 4, "expected 4 frames at 30 a second, found 3"),
        (("sequences", "walk", "frames"), 2, "one_to_many: walk has 2 frames, found 1-2"),
        (("fps",), 25.0, "expected 3 frames at 25 a second, found 3 at 30"),
        (("fps",), None, "expected 'fps' as int or float, found None"),
        (("sequences", "walk", "split"), "dev", "unseen_validation, unseen_test, found 'dev'"),
        (("one_to_many", 0, "at_rest"), [0, 3], "walk has 3 frames, found 0-3"),
        (("one_to_many", 0, "sequence"), "run", "no sequence 'run'"),
    ],
)
def test_a_wrong_record_is_refused_by_name(folder, path, value, message):
    _edit(folder, *path, value=value)
    with pytest.raises(CaptureError, match=message):
        open_capture(folder)


def test_mirrored_cameras_are_refused(folder):
    record = json.loads((folder / "capture.json").read_text())
    rows = record["cameras"][0]["T_camera_world"]
    _edit(folder, "cameras", 0, "T_camera_world", 0, value=[-x for x in rows[0]])
    with pytest.raises(CaptureError, match=r"determinant -1\.000"):
        open_capture(folder)


def test_missing_frames_are_counted_and_skipped_for_their_camera_only(folder, caplog):
    (folder / "walk/cam1/0001.png").unlink()
    capture = open_capture(folder)
    assert "cam1 lacks 1 of 3 frames, the first is 1; it does without" in caplog.text
    assert [capture.cameras_with_image("walk", frame) for frame in range(3)] == [[0, 1], [0], [0, 1]]


def test_a_camera_without_any_frame_is_refused(folder):
    shutil.rmtree(folder / "walk/cam1")
    with pytest.raises(CaptureError, match="cam1 has none of 3 frames; expected cam1/0000"):
        open_capture(folder)


def test_an_image_without_mask_is_refused(folder):
    Image.fromarray(_image(0, 0)[..., :3]).save(folder / "walk/cam0/0000.png")
    with pytest.raises(CaptureError, match="expected RGBA, found RGB; the mask"):
        open_capture(folder)


def test_a_damaged_image_is_named_when_it_is_read(folder):
    (folder / "walk/cam0/0002.png").write_bytes(b"no image")
    capture = open_capture(folder)
    with pytest.raises(CaptureError, match=r"image cam0/0002\.png.*cannot be decoded"):
        capture.image("walk", 2, 0)


@pytest.mark.parametrize(("sequence", "frame"), [("run", 0), ("walk", 3), ("walk", -1)])
def test_images_that_do_not_exist_are_refused(folder, sequence, frame):
    with pytest.raises(CaptureError, match="there are"):
        open_capture(folder).image(sequence, frame, 0)


def test_a_folder_without_record_is_refused(tmp_path):
    with pytest.raises(CaptureError, match=r"no format that we know: our own \(capture\.json\)"):
        open_capture(tmp_path)


def test_garment_runs_are_counted(folder):
    capture = open_capture(folder)
    assert (capture.garment_runs("walk"), capture.garment_runs("run")) == (1, 0)


def test_unknown_garments_and_runs_are_refused(folder):
    capture = open_capture(folder)
    with pytest.raises(CaptureError, match="no garment truth for 'run'; it has walk"):
        capture.garment("run")
    with pytest.raises(CaptureError, match="expected run1, found"):
        capture.garment("walk", run=1)


@pytest.fixture(scope="module")
def embedded():
    return open_capture()


def test_a_capture_whose_format_says_which_way_is_up_is_read_without_a_word(folder, caplog):
    with caplog.at_level("INFO"):
        open_capture(folder)
    assert not caplog.records


def test_embedded_capture_fits_in_the_package():
    assert sum(path.stat().st_size for path in EMBEDDED_CAPTURE.rglob("*") if path.is_file()) < 50e6


def test_embedded_capture_trains_on_eight_hundred_frames(embedded):
    assert len(embedded.cameras) == 8
    assert sum(len(embedded.motions[name]) for name in embedded.splits["train"]) >= 800
    assert embedded.splits["nd"] == ("near",)
    assert embedded.splits["fd"] == ("far",)


def test_embedded_one_to_many_frames_share_the_pose_and_not_the_cloth(embedded):
    (pair,) = embedded.one_to_many
    motion, cloth = embedded.motions[pair.sequence], embedded.garment(pair.sequence)
    rest, stop = pair.at_rest[0], slice(pair.after_stop[0], pair.after_stop[1] + 1)
    # Written Z up and turned back: equal poses stay equal to float32's last digits.
    torch.testing.assert_close(
        motion.rotations[stop], motion.rotations[rest].expand_as(motion.rotations[stop]), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        motion.translations[stop],
        motion.translations[rest].expand_as(motion.translations[stop]),
        atol=1e-6,
        rtol=0,
    )
    distance = np.sqrt(((cloth[stop] - cloth[rest]) ** 2).sum(-1).mean(-1))
    assert (distance[:30] > 0.05).all()


def test_embedded_truth_is_repeatable_enough_to_be_learnt(embedded):
    for name in embedded.splits["test"]:
        first, second = embedded.garment(name), embedded.garment(name, run=1)
        runs = np.sqrt(((first - second) ** 2).sum(-1).mean())
        motion = embedded.motions[name]
        pelvis = forward_kinematics(embedded.body, motion.rotations, motion.translations)[:, 0].numpy()
        carried = first[0] @ np.linalg.inv(pelvis[0])[:3, :3].T + np.linalg.inv(pelvis[0])[:3, 3]
        carried = carried @ pelvis[:, :3, :3].transpose(0, 2, 1) + pelvis[:, None, :3, 3]
        assert runs < 0.5 * np.sqrt(((first - carried) ** 2).sum(-1).mean())


def test_embedded_garment_projects_into_the_masks(embedded):
    cloth = torch.from_numpy(embedded.garment("far"))
    for index, camera in enumerate(embedded.cameras):
        for frame in (0, 60, 75):
            alpha = embedded.image("far", frame, index)[..., 3]
            pixels, _ = project(camera, cloth[frame])
            column, row = pixels.floor().long().T.numpy()
            # Millimetre truth against masks of 8 mm pixels: the hem may round over an edge.
            assert (alpha[row, column] > 0).mean() > 0.98


def test_some_cameras_are_spread_out_and_show_what_they_showed(tiny_capture):
    whole = open_capture(tiny_capture)
    half = whole.with_cameras(2)
    centers = [-c.T_camera_world[:3, :3].T @ c.T_camera_world[:3, 3] for c in whole.cameras]
    names = [camera.name for camera in half.cameras]
    farthest = max(range(len(centers)), key=lambda i: float((centers[i] - centers[0]).norm()))
    assert names == sorted({whole.cameras[0].name, whole.cameras[farthest].name}, key=names.index)
    sequence = next(iter(whole.motions))
    index = [camera.name for camera in whole.cameras].index(names[1])
    assert np.array_equal(half.image(sequence, 0, 1), whole.image(sequence, 0, index))
    assert whole.with_cameras(None) is whole
    assert [camera.name for camera in pickle.loads(pickle.dumps(half)).cameras] == names
    with pytest.raises(ConfigError, match="cameras is 99"):
        whole.with_cameras(99)
