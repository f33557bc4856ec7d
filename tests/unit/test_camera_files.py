"""Cameras in JSON: those of a capture, those that move, and files that are wrong."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from dsar.data.captures.formats import EMBEDDED_CAPTURE, open_capture
from dsar.errors import ConfigError
from dsar.geometry.camera_files import list_cameras_json, read_cameras_json, write_cameras_json
from dsar.geometry.camera_paths import CameraPath
from dsar.geometry.cameras import look_at
from dsar.types import Camera


def camera(name: str, place: float, focal: float = 300.0) -> Camera:
    K = torch.tensor([[focal, 0.0, 100.3], [0.0, 310.0, 130.7], [0.0, 0.0, 1.0]])
    return Camera(K, look_at(np.array([place, 1.0, 3.0]), np.array([0.0, 1.0, 0.0])), 192, 256, name)


MOVING = CameraPath(tuple(camera("moving", 0.3 * i) for i in range(3)), (1001, 1005, 1010))


@pytest.fixture
def rig() -> list[CameraPath]:
    """One at rest, one that moves, one that zooms as well."""
    return [
        CameraPath((camera("still", 0.1),)),
        CameraPath(tuple(camera("moving", 0.3 * i) for i in range(3)), (-2, 1001, 1010)),
        CameraPath(tuple(camera("zoom", 0.3, 300.0 + i) for i in range(2)), (1001, 1002)),
    ]


def matrices(path: CameraPath) -> torch.Tensor:
    return torch.cat([torch.cat([view.K.ravel(), view.T_camera_world.ravel()]) for view in path.cameras])


def spoilt(path: Path, *keys: str | int, value: object) -> Path:
    record = json.loads(path.read_text())
    target = record
    for key in keys[:-1]:
        target = target[key]
    target[keys[-1]] = value
    path.write_text(json.dumps(record))
    return path


def test_written_cameras_come_back_to_the_bit(rig, tmp_path):
    path = write_cameras_json(rig, tmp_path / "new" / "cameras.json")
    back = read_cameras_json(path)
    assert [each.name for each in back] == ["still", "moving", "zoom"]
    for one, two in zip(rig, back, strict=True):
        assert one.frames == two.frames
        assert torch.equal(matrices(one), matrices(two))
        assert (two.cameras[0].width, two.cameras[0].height) == (192, 256)
    assert list(path.parent.iterdir()) == [path]


def test_a_captures_own_record_is_a_camera_file():
    paths = read_cameras_json(EMBEDDED_CAPTURE / "capture.json")
    cameras = open_capture("embedded").cameras
    assert [path.name for path in paths] == [each.name for each in cameras]
    for path, expected in zip(paths, cameras, strict=True):
        assert path.frames == ()
        assert torch.equal(path.cameras[0].K, expected.K)
        assert torch.equal(path.cameras[0].T_camera_world, expected.T_camera_world)


def test_frames_override_the_still_camera_in_any_order(tmp_path):
    one, two = camera("a", 0.0), camera("a", 1.0, focal=350.0)
    entry = {"name": "a", "width": 192, "height": 256, "K": one.K.tolist()}
    entry["T_camera_world"] = one.T_camera_world.tolist()
    frames = {
        "1010": {"K": two.K.tolist()},
        "1001": {"T_camera_world": two.T_camera_world.tolist()},
    }
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"cameras": [{**entry, "frames": frames}]}))
    (found,) = read_cameras_json(path)
    assert found.frames == (1001, 1010)
    assert torch.equal(found.at(1001).T_camera_world, two.T_camera_world)
    assert torch.equal(found.at(1001).K, one.K)
    assert torch.equal(found.at(1010).T_camera_world, one.T_camera_world)
    assert torch.equal(found.at(1010).K, two.K)


@pytest.mark.parametrize(
    ("own", "wanted", "keys"),
    [
        (24, 30.0, (1001, 1006, 1012.25)),
        (24.0, 60.0, (1001, 1011, 1023.5)),
        (30, 24000 / 1001, (1001, 1001 + 3200 / 1001, 1001 + 7200 / 1001)),
        (29.97, 30000 / 1001, (1001, 1005, 1010)),
        (24.0, None, (1001, 1005, 1010)),
        (None, 30.0, (1001, 1005, 1010)),
    ],
)
def test_cameras_of_another_rate_are_where_they_are_by_seconds(tmp_path, own, wanted, keys):
    path = write_cameras_json([MOVING], tmp_path / "cameras.json")
    if own is not None:
        path.write_text(json.dumps({"fps": own, **json.loads(path.read_text())}))
    (found,) = read_cameras_json(path, fps=wanted)
    assert found.frames == pytest.approx(keys, abs=1e-9)
    for key, expected in zip(found.frames, MOVING.cameras, strict=True):
        assert torch.equal(found.at(key).T_camera_world, expected.T_camera_world)
    # A file that says its frames anew says the same.
    (again,) = read_cameras_json(write_cameras_json([found], tmp_path / "again.json"))
    assert again.frames == found.frames


@pytest.mark.parametrize("rate", [0, -24, "24", True, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(tmp_path, rate):
    path = write_cameras_json([MOVING], tmp_path / "cameras.json")
    path.write_text(json.dumps({"fps": rate, **json.loads(path.read_text())}))
    with pytest.raises(ConfigError, match=r"cameras\.json: expected fps as a number > 0, found"):
        read_cameras_json(path, fps=24.0)


FLAT = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("cameras",), [], "expected {\"cameras\": [...]} with at least one camera, found {'cameras': []}"),
        (("cameras",), {"a": 1}, "with at least one camera"),
        (("cameras", 0), 7, "camera 0: expected name, K, T_camera_world, width and height, found 7"),
        (
            ("cameras", 0, "name"),
            "front left",
            "letters, digits and _ (no leading digit), found 'front left'",
        ),
        (("cameras", 0, "name"), "0004", "found '0004': rename"),
        (("cameras", 0, "name"), "Käte", "found 'Käte': rename"),
        (("cameras", 0, "name"), None, "found None: rename"),
        (("cameras", 0, "name"), "zoom", "expected names that differ, found zoom twice: rename one"),
        (("cameras", 0, "width"), 0, "camera 0 still: expected width in pixels, a whole number > 0, found 0"),
        (("cameras", 0, "height"), 12.5, "expected height in pixels, a whole number > 0, found 12.5"),
        (("cameras", 0, "height"), True, "expected height in pixels, a whole number > 0, found True"),
        (("cameras", 0, "K"), None, "expected K as a 3x3 list of finite numbers, found None"),
        (("cameras", 0, "K"), FLAT, "expected K as a 3x3 list of finite numbers, found [[1, 0, 0, 0]"),
        (("cameras", 0, "K", 0), [300.0], "expected K as a 3x3 list"),
        (("cameras", 0, "K", 0, 0), "300", "expected K as a 3x3 list"),
        (("cameras", 0, "K", 0, 0), float("nan"), "expected K as a 3x3 list of finite numbers"),
        (("cameras", 0, "K", 0, 0), 10**400, "expected K as a 3x3 list of finite numbers"),
        (("cameras", 0, "K", 0, 0), -300.0, "expected K as [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels"),
        (("cameras", 0, "K", 2, 2), 2.0, "expected K as [[fx, s, cx]"),
        (("cameras", 0, "T_camera_world", 0, 3), float("inf"), "T_camera_world as a 4x4 list of finite"),
        (("cameras", 0, "T_camera_world", 0, 0), 2.0, "expected T_camera_world as a rotation"),
        (("cameras", 0, "T_camera_world"), [[-1, 0, 0, 0], *FLAT[1:]], "determinant -1.000"),
        (("cameras", 0, "T_camera_world", 3), [0, 0, 1, 1], "last row [0.0, 0.0, 1.0, 1.0]"),
        (("cameras", 1, "frames"), {}, "camera 1 moving: expected frames by number, at least one, found {}"),
        (("cameras", 1, "frames"), [FLAT], "at least one, found [[[1, 0"),
        (("cameras", 1, "frames", "first"), {}, "each number once, found 'first': {}: correct it"),
        (("cameras", 1, "frames", "01001"), {}, "each number once, found '01001': {}"),
        (("cameras", 1, "frames", "1001"), FLAT, "each number once, found '1001': [[1, 0"),
        (("cameras", 1, "frames", "1001"), {}, "moving, frame 1001: expected T_camera_world as a 4x4 list"),
        (("cameras", 1, "frames", "1010", "T_camera_world", 1, 1), 3.0, "moving, frame 1010: expected T_c"),
    ],
)
def test_a_wrong_file_is_refused_by_name_and_place(rig, tmp_path, keys, value, message):
    path = spoilt(write_cameras_json(rig, tmp_path / "cameras.json"), *keys, value=value)
    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        read_cameras_json(path)
    assert str(caught.value).startswith(str(path))


def test_only_chosen_cameras_are_judged(rig, tmp_path):
    path = spoilt(write_cameras_json(rig, tmp_path / "cameras.json"), "cameras", 0, "K", value="none")
    assert list_cameras_json(path) == ["still", "moving", "zoom"]
    assert [each.name for each in read_cameras_json(path, chosen={"zoom", "moving"})] == ["moving", "zoom"]
    with pytest.raises(ConfigError, match="camera 0 still: expected K"):
        read_cameras_json(path, chosen={"still"})


@pytest.mark.parametrize("name", ["../../x", "/etc/x", "a/b", "..", "a\\b", ""])
def test_a_name_that_would_be_a_path_is_refused(rig, tmp_path, name):
    path = spoilt(write_cameras_json(rig, tmp_path / "cameras.json"), "cameras", 0, "name", value=name)
    for read in (list_cameras_json, read_cameras_json):
        with pytest.raises(ConfigError, match="expected a name of letters, digits and _"):
            read(path)


@pytest.mark.parametrize("contents", [b"{", b"\xff\xfe", b"[]", b"3", None])
def test_what_is_no_camera_file_is_refused(tmp_path, contents):
    path = tmp_path / "cameras.json"
    if contents is not None:
        path.write_bytes(contents)
    with pytest.raises(ConfigError, match=r"cameras\.json: expected"):
        read_cameras_json(path)


def test_what_could_not_be_read_again_is_not_written(tmp_path):
    path = tmp_path / "cameras.json"
    still = CameraPath((camera("a", 0.0),))
    wrong = CameraPath((camera("front left", 0.0),))
    for paths, message in (([], "found none"), ([still, still], "a twice"), ([wrong], "'front left'")):
        with pytest.raises(ConfigError, match=message):
            write_cameras_json(paths, path)
    assert not path.exists()
