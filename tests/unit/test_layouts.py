"""Captures in the layouts of public data sets say what the capture said that they were written from."""

import json
import pickle
import shutil

import layouts
import numpy as np
import pytest
import torch

from dsar.body.files import EMBEDDED_BODY, load_body
from dsar.body.skinning import pose_vertices
from dsar.data.captures.formats import open_capture
from dsar.data.captures.scans import _load
from dsar.errors import BodyError, CaptureError, DsarError, MotionError
from dsar.geometry.cameras import project
from dsar.raster.mesh import rasterize_mesh

SEQUENCE = "turn"
RANGES = {"train_frames": "0-7", "test_frames": "9-13"}
X_DOWN = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
Y_DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
WRITERS = {
    "avatarrex": (layouts.write_avatarrex, None),
    "thuman4": (layouts.write_thuman4, Y_DOWN),
    "actorshq": (layouts.write_actorshq, layouts.z_up()),
}


@pytest.fixture(scope="session")
def original(tiny_capture):
    return open_capture(tiny_capture)


@pytest.fixture(scope="session")
def written(original, tmp_path_factory):
    """Folders by layout, and the body file with hands of 4D-DRESS."""
    folder = tmp_path_factory.mktemp("layouts")
    for name, (write, turn) in WRITERS.items():
        write(original, SEQUENCE, folder / name, turn)
    hands = layouts.body_with_hands(folder / "body.npz")
    layouts.write_dress(original, ["turn", "sway", "bend"], folder / "dress", X_DOWN, hands=hands, scans=True)
    return folder


@pytest.fixture
def folder(written, tmp_path):
    """A copy to spoil, by layout."""

    def copy(name):
        return shutil.copytree(written / name, tmp_path / name)

    return copy


class Intruder:
    """Would run code when it is unpickled."""

    def __reduce__(self):
        return (exec, ("raise SystemExit('code was run')",))


def ranges_of(name):
    return {} if name == "dress" else RANGES


def body_of(written, name):
    return written / "body.npz" if name == "dress" else EMBEDDED_BODY


def open_written(written, name):
    return open_capture(written / name, body=body_of(written, name), **ranges_of(name))


def assert_same_views(capture, original, parts, tolerance):
    """Posed bodies fall on the same pixels of the same images. `parts`: sequence, its original and start."""
    for ours, (theirs, start) in parts.items():
        for frame in range(0, len(capture.motions[ours]), 3):
            vertices = [
                pose_vertices(each.body, each.motions[name][number])[::50]
                for each, name, number in ((capture, ours, frame), (original, theirs, start + frame))
            ]
            for index, camera in enumerate(original.cameras):
                found = project(capture.cameras[index], vertices[0])
                expected = project(camera, vertices[1])
                torch.testing.assert_close(found[0], expected[0], atol=2e-3, rtol=0)
                torch.testing.assert_close(found[1], expected[1], atol=2e-4, rtol=0)
                image, true = capture.image(ours, frame, index), original.image(theirs, start + frame, index)
                assert np.abs(image[..., 3].astype(int) - true[..., 3]).max() <= tolerance
                shown = (true[..., 3] > 200) & (image[..., 3] > 200)
                difference = np.abs(image[..., :3].astype(int) - true[..., :3])[shown]
                assert difference.mean() <= tolerance / 4


@pytest.mark.parametrize("name", WRITERS)
def test_a_single_take_is_cut_and_says_what_the_original_said(written, original, name):
    capture = open_written(written, name)
    parts = list(capture.motions)
    assert [len(motion) for motion in capture.motions.values()] == [8, 5]
    assert (capture.splits["train"], capture.splits["test"]) == ((parts[0],), (parts[1],))
    assert capture.fps == (25.0 if name == "actorshq" else 30.0)
    assert_same_views(capture, original, {parts[0]: (SEQUENCE, 0), parts[1]: (SEQUENCE, 9)}, 8)


def test_takes_of_4d_dress_say_what_the_original_said_to_the_bit(written, original):
    capture = open_written(written, "dress")
    assert (capture.splits["train"], capture.splits["test"]) == (("Take1", "Take2"), ("Take3",))
    assert_same_views(
        capture, original, {"Take1": ("turn", 0), "Take2": ("sway", 0), "Take3": ("bend", 0)}, 0
    )


def test_virtual_cameras_see_the_scans_where_the_body_is(written, original):
    capture = open_written(written, "dress")
    assert [camera.name for camera in capture.cameras][-4:] == ["scan0", "scan1", "scan2", "scan3"]
    for index in range(4, 8):
        image, camera = capture.image("Take1", 5, index), capture.cameras[index]
        vertices = pose_vertices(capture.body, capture.motions["Take1"][5])
        pixels, depth = project(camera, vertices)
        column, row = pixels.floor().long().T.numpy()
        assert (depth > 0).all()
        # A vertex on the silhouette's edge may lie in a pixel of which no sample is covered.
        shown = torch.nn.functional.max_pool2d(torch.tensor(image[None, None, ..., 3]).float(), 3, 1, 1)[0, 0]
        assert float((shown[row, column] > 0).float().mean()) > 0.999
        assert (image[row, column, 3] > 0).mean() > 0.9
        # Feet are red and heads blue: the texture is the right way up.
        rows = np.flatnonzero((image[..., 3] > 200).any(1))
        top, bottom = (image[rows[k]][image[rows[k], :, 3] > 200].mean(0) for k in (1, -2))
        assert top[2] > 150 > 100 > top[0]
        assert bottom[0] > 150 > 100 > bottom[2]


def test_virtual_cameras_stand_between_the_released_ones(written):
    capture = open_written(written, "dress")
    centers = torch.stack([camera.center for camera in capture.cameras])
    azimuths = torch.atan2(centers[:, 0], centers[:, 2])
    apart = (azimuths[4:, None] - azimuths[None, :4] + np.pi).remainder(2 * np.pi) - np.pi
    assert float(apart.abs().min()) > 0.4


def test_labels_of_the_scans_say_where_the_garment_is(written, original):
    capture = open_written(written, "dress")
    height, joints = capture.body.vertices[:, 1], capture.body.joints[:, 1]
    lower = (height > joints[4]) & (height < joints[0])
    for index in (1, 6):
        image, mask = capture.image("Take1", 5, index), capture.garment_mask("Take1", 5, index)
        assert mask.shape == image.shape[:2]
        assert not mask[image[..., 3] == 0].any()
        vertices = pose_vertices(capture.body, capture.motions["Take1"][5])
        view = rasterize_mesh(vertices, capture.body.faces, capture.cameras[index])
        seen = capture.body.faces[view.faces.clamp_min(0)]
        expected = (view.faces >= 0) & lower[seen].all(-1)
        border = (view.faces >= 0) & lower[seen].any(-1)
        assert mask[expected.numpy()].all()
        assert not mask[~border.numpy()].any()
    assert original.garment_mask("turn", 0, 0) is None


def test_an_outer_garment_is_the_garment_of_a_frame_that_has_one(folder, written):
    root = folder("dress")
    path = root / "Take1/Semantic/labels/label-f00016.pkl"
    labels = pickle.loads(path.read_bytes())["scan_labels"]
    heights = open_capture(root, body=written / "body.npz").body.vertices[:, 1].numpy()
    path.write_bytes(pickle.dumps({"scan_labels": np.where(heights > heights.mean(), 5, labels)}))
    capture = open_capture(root, body=written / "body.npz")
    before, after = (capture.garment_mask("Take1", frame, 0) for frame in (4, 5))
    assert np.flatnonzero(after.any(1)).max() < np.flatnonzero(before.any(1)).max()
    path.unlink()
    assert open_capture(root, body=written / "body.npz").garment_mask("Take1", 5, 0) is None


@pytest.mark.parametrize(
    "content", [{}, {"scan_labels": np.zeros(7)}, {"scan_labels": "skin"}, [1], {"scan_labels": None}]
)
def test_broken_labels_are_named_when_they_are_asked_for(folder, written, content):
    root = folder("dress")
    path = root / "Take1/Semantic/labels/label-f00013.pkl"
    path.write_bytes(pickle.dumps(content))
    capture = open_capture(root, body=written / "body.npz")
    with pytest.raises(CaptureError, match=r"labels .*label-f00013\.pkl: expected"):
        capture.garment_mask("Take1", 2, 0)


@pytest.mark.parametrize("name", [*WRITERS, "dress"])
def test_captures_are_opened_anew_in_other_processes(written, name):
    capture = open_written(written, name).with_cameras(2)
    data = pickle.dumps(capture)
    again = pickle.loads(data)
    assert len(data) < 2000
    assert [camera.name for camera in again.cameras] == [camera.name for camera in capture.cameras]
    sequence = capture.splits["test"][0]
    assert np.array_equal(again.image(sequence, 2, 1), capture.image(sequence, 2, 1))


def test_without_ranges_two_thirds_train_and_a_gap_is_left(written, original, tmp_path):
    from dsar.data.captures.splits import GAP, split_take

    assert split_take(300, None, None) == (range(200), range(200 + GAP, 300))
    assert split_take(300, "0-99", None) == (range(100), range(200 + GAP, 300))
    assert split_take(300, "0-250", None) == (range(251), range(251 + GAP, 300))
    with pytest.raises(CaptureError, match=r"no frames are left to test with.*gap of 40"):
        open_capture(written / "avatarrex", body=EMBEDDED_BODY)


def test_a_memory_that_reaches_into_the_test_is_warned_of(written, caplog):
    open_written(written, "avatarrex")
    assert "a memory reaches from one to the other" in caplog.text


def test_listed_and_absent_images_are_skipped_for_their_camera_only(folder, caplog):
    root = folder("avatarrex")
    (root / "missing_img_files.txt").write_text(f"avatarrex\\{layouts.SERIALS[1]}\\00000002.jpg\r\n\r\n")
    (root / layouts.SERIALS[2] / "mask/pha/00000003.jpg").unlink()
    capture = open_written(root.parent, "avatarrex")
    train = capture.splits["train"][0]
    seen = [capture.cameras_with_image(train, frame) for frame in range(5)]
    everyone = list(range(4))
    assert seen == [everyone, everyone, [0, 2, 3], [0, 1, 3], everyone]
    assert f"cam_{layouts.SERIALS[1]} 1, cam_{layouts.SERIALS[2]} 1 of 14" in caplog.text


def test_a_camera_without_any_image_is_named(folder):
    root = folder("thuman4")
    shutil.rmtree(root / "masks/cam02")
    with pytest.raises(
        CaptureError, match=r"cam02 has no image with a mask; expected .*images/cam02/00000000"
    ):
        open_written(root.parent, "thuman4")


def test_without_the_right_body_the_embedded_one_stands_in_and_that_is_said(written, caplog, monkeypatch):
    monkeypatch.delenv("DSAR_BODY", raising=False)
    capture = open_capture(written / "avatarrex", **RANGES)
    assert "was fitted with a neutral SMPL-X body" in caplog.text
    assert capture.body_path is None
    assert torch.equal(capture.body.vertices, load_body().vertices)


def test_the_body_comes_from_the_environment_where_a_capture_brings_none(written, tiny_capture, monkeypatch):
    monkeypatch.setenv("DSAR_BODY", str(written / "body.npz"))
    assert open_capture(written / "avatarrex", **RANGES).body_path == written / "body.npz"
    assert open_capture(tiny_capture).body_path is None


def test_a_folder_of_bodies_gives_the_one_of_the_captures_gender(written, tmp_path):
    for gender in ("NEUTRAL", "MALE"):
        shutil.copy(written / "body.npz", tmp_path / f"SMPLX_{gender}.npz")
    assert open_capture(written / "dress", body=tmp_path).body_path == tmp_path / "SMPLX_NEUTRAL.npz"
    (tmp_path / "SMPLX_NEUTRAL.npz").unlink()
    with pytest.raises(BodyError, match=r"neither SMPLX_NEUTRAL\.npz nor"):
        open_capture(written / "dress", body=tmp_path)


def test_hands_as_components_need_the_models_own(written, caplog):
    with pytest.raises(BodyError, match="lacks hands_componentsl"):
        open_capture(written / "dress", body=EMBEDDED_BODY)


@pytest.mark.parametrize(
    ("name", "path", "content", "message"),
    [
        ("avatarrex", "calibration_full.json", "[1", "cannot be read as JSON"),
        ("avatarrex", "calibration_full.json", "[]", "expected cameras by name, found a list"),
        ("avatarrex", "calibration_full.json", "{}", "expected cameras whose names differ"),
        ("avatarrex", "missing_img_files.txt", "one two", r"line 1: expected CAMERA/FRAME\.jpg"),
        ("actorshq", "4x/calibration.csv", "name,w\nCam001,48\n", "expected name,w,h,rx"),
        ("avatarrex", "smpl_params.npz", "nothing", "cannot be read"),
        (
            "dress",
            "Take1/Capture/cameras.pkl",
            Intruder(),
            r"cameras\.pkl.*builtins\.exec, which is not data",
        ),
        ("dress", "Take1/SMPLX/mesh-f00012_smplx.pkl", Intruder(), "mesh-f00012_smplx.*is not data"),
        ("dress", "Take2/basic_info.pkl", {"scan_frames": []}, "names of frames"),
        ("dress", "Take2/basic_info.pkl", {"scan_frames": 7}, "names of frames"),
        ("dress", "Take2/basic_info.pkl", [1], "expected a dictionary, found a list"),
        ("dress", "Take1/SMPLX/mesh-f00013_smplx.pkl", b"\x80", "mesh-f00013_smplx.*cannot be read"),
    ],
)
def test_a_broken_file_is_refused_with_its_name_and_fault(folder, written, name, path, content, message):
    where = folder(name) / path
    if isinstance(content, str):
        content = content.encode()
    where.write_bytes(content if isinstance(content, bytes) else pickle.dumps(content))
    with pytest.raises(DsarError, match=message) as caught:
        open_capture(where.parents[len(path.split("/")) - 1], body=body_of(written, name), **ranges_of(name))
    assert where.name in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"R": None}, "camera cam01.*found no R"),
        ({"T": [0.0]}, "expected T of 3 numbers"),
        ({"K": ["a"] * 9}, "K is not made of numbers"),
        ({"R": [2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]}, "expected T_camera_world as a rotation"),
        ({"imgSize": [48]}, "expected imgSize"),
        ({"distCoeff": [0.1] * 8}, "expected distCoeff as k1, k2, p1, p2, k3"),
        ({"distCoeff": [float("nan")]}, "expected distCoeff"),
    ],
)
def test_a_broken_camera_is_refused_with_its_name_and_fault(folder, changes, message):
    root = folder("thuman4")
    record = json.loads((root / "calibration.json").read_text())
    record["cam01"] = {key: value for key, value in (record["cam01"] | changes).items() if value is not None}
    (root / "calibration.json").write_text(json.dumps(record))
    with pytest.raises(CaptureError, match=message) as caught:
        open_written(root.parent, "thuman4")
    assert "camera cam01" in str(caught.value)


def spoil_fit(root, **changes):
    path = root / "Take1/SMPLX/mesh-f00015_smplx.pkl"
    path.write_bytes(pickle.dumps(pickle.loads(path.read_bytes()) | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"body_pose": np.zeros(60)}, "body_pose has 60 numbers, expected 63"),
        ({"transl": np.array([0.0, np.nan, 0.0])}, "transl has values that are not finite"),
        ({"left_hand_pose": np.zeros(46)}, "left_hand_pose has 46 numbers"),
        ({"betas": "thin"}, "betas is not made of numbers"),
        ({"betas": np.zeros(9)}, "betas has 9 numbers, .*mesh-f00011_smplx.* 10"),
    ],
)
def test_a_broken_fit_is_refused_with_its_frame(folder, written, changes, message):
    root = folder("dress")
    spoil_fit(root, **changes)
    with pytest.raises(MotionError, match=f"mesh-f00015_smplx.*{message}"):
        open_capture(root, body=written / "body.npz")


def test_poses_that_are_not_finite_are_refused_with_their_frame(folder):
    root = folder("avatarrex")
    with np.load(root / "smpl_params.npz") as file:
        arrays = {key: file[key].copy() for key in file.files}
    arrays["body_pose"][6, 3] = np.inf
    np.savez(root / "smpl_params.npz", **arrays)
    with pytest.raises(MotionError, match="body_pose has 1 values that are not finite, first at frame 6"):
        open_written(root.parent, "avatarrex")
    arrays["body_pose"] = arrays["body_pose"][:5]
    np.savez(root / "smpl_params.npz", **arrays)
    with pytest.raises(MotionError, match="expected"):
        open_written(root.parent, "avatarrex")
    np.savez(
        root / "smpl_params.npz",
        **{key: array[:0] if len(array) > 1 else array for key, array in arrays.items()},
    )
    with pytest.raises(MotionError, match="has no frames"):
        open_written(root.parent, "avatarrex")


@pytest.mark.parametrize("betas", [None, np.zeros((1, 0))])
def test_a_take_without_a_shape_is_refused(folder, betas):
    root = folder("avatarrex")
    with np.load(root / "smpl_params.npz") as file:
        arrays = {key: file[key] for key in file.files if key != "betas"}
    np.savez(root / "smpl_params.npz", **arrays, **({} if betas is None else {"betas": betas}))
    with pytest.raises(CaptureError, match=r"smpl_params\.npz: expected the person's shape as betas"):
        open_written(root.parent, "avatarrex")


def test_takes_that_were_calibrated_apart_are_refused(folder, written):
    root = folder("dress")
    path = root / "Take2/Capture/cameras.pkl"
    cameras = pickle.loads(path.read_bytes())
    cameras["0028"]["extrinsics"][0, 3] += 0.01
    path.write_bytes(pickle.dumps(cameras))
    with pytest.raises(CaptureError, match=r"Take2/Capture/cameras\.pkl: differs from that of Take1"):
        open_capture(root, body=written / "body.npz")
    assert open_capture(
        root / "Take2", body=written / "body.npz", train_frames="0-5", test_frames="6-9"
    ).cameras


@pytest.mark.parametrize(
    "changes",
    [{"faces": np.zeros((0, 3))}, {"faces": np.array(3)}, {"uvs": np.zeros((5, 2))}, {"vertices": None}],
)
def test_a_broken_scan_is_named_when_it_is_seen(folder, written, changes):
    root = folder("dress")
    path = root / "Take1/Meshes_pkl/mesh-f00013.pkl"
    path.write_bytes(pickle.dumps(pickle.loads(path.read_bytes()) | changes))
    capture = open_capture(root, body=written / "body.npz")
    with pytest.raises(CaptureError, match=r"scan .*mesh-f00013\.pkl: expected"):
        capture.image("Take1", 2, 5)


def test_our_own_captures_take_another_body_and_warn(tiny_capture, written, tmp_path, caplog):
    shutil.copy(written / "body.npz", tmp_path / "SMPLX_NEUTRAL.npz")
    capture = open_capture(tiny_capture, body=tmp_path)
    assert capture.body_path == tmp_path / "SMPLX_NEUTRAL.npz"
    assert "were fitted with the embedded body" in caplog.text


def test_truncated_and_wrongly_sized_images_are_named_when_read(folder):
    from PIL import Image

    root = folder("avatarrex")
    color = root / layouts.SERIALS[0] / "00000002.jpg"
    color.write_bytes(color.read_bytes()[:300])
    Image.new("L", (10, 20)).save(root / layouts.SERIALS[1] / "mask/pha/00000004.jpg")
    capture = open_written(root.parent, "avatarrex")
    train = capture.splits["train"][0]
    with pytest.raises(CaptureError, match=r"22010708/00000002\.jpg: cannot be decoded"):
        capture.image(train, 2, 0)
    with pytest.raises(
        CaptureError,
        match=r"mask/pha/00000004\.jpg: expected 48x64 pixels as camera cam_22010710 says, found 10x20",
    ):
        capture.image(train, 4, 1)


def test_a_folder_of_no_known_format_is_refused_with_the_formats(tmp_path):
    with pytest.raises(
        CaptureError, match=r"no format that we know: our own .*AvatarReX.*THuman4.*ActorsHQ.*4D-DRESS"
    ):
        open_capture(tmp_path)


def test_a_scan_that_was_replaced_is_read_anew(tmp_path):
    path = tmp_path / "mesh.pkl"
    for content in ({"faces": 1}, {"faces": 2}):
        path.write_bytes(pickle.dumps(content))
        assert _load(path) == content
