"""`dsar check` passes a clean capture and names what is wrong with a spoilt one."""

import json
import math
import shutil

import layouts
import numpy as np
import pytest
import torch
from PIL import Image

from dsar.body.files import load_body
from dsar.body.skinning import pose_vertices
from dsar.cli import main
from dsar.data.captures.formats import open_capture
from dsar.data.motions.files import write_motion
from dsar.errors import CaptureError
from dsar.evaluation.check import check_capture, draw_overlays
from dsar.evaluation.check.silhouettes import silhouette
from dsar.geometry.cameras import look_at
from dsar.types import Camera, Motion

HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
WIDTH, HEIGHT, FRAMES = 105, 140, 12
SEQUENCES = {"train": "sway", "test": "turn"}


def cameras():
    made = []
    for index, angle in enumerate((0.2, 1.9, 3.4, 4.9)):
        place = np.array([2.6 * math.sin(angle), 0.25 * index - 0.4, 2.6 * math.cos(angle)])
        K = torch.tensor([[144.0, 0.0, 50.0 + 2 * index], [0.0, 142.0, 73.0 - 2 * index], [0.0, 0.0, 1.0]])
        made.append(Camera(K, look_at(place, np.array([0.05, -0.1, 0.0])), WIDTH, HEIGHT, f"cam{index}"))
    return made


def motions(hands=None):
    made = {}
    for number, name in enumerate(SEQUENCES.values()):
        t = torch.arange(FRAMES) / 30
        rotations, translations = torch.zeros(FRAMES, 55, 3), torch.zeros(FRAMES, 3)
        rotations[:, 16, 2], rotations[:, 17, 2] = -0.9 + torch.sin(9 * t), 1.1 - 0.6 * torch.sin(7 * t)
        rotations[:, 0, 1] = (1.5 - 3 * number) * t
        rotations[:, 1, 0], rotations[:, 4, 0] = -0.8 * torch.sin(6 * t).abs(), 0.6 * torch.sin(6 * t).abs()
        rotations[:, 3, 0] = 0.2
        translations[:, 0], translations[:, 2] = 0.3 * torch.sin(5 * t), 0.1 * t
        if hands is not None:
            rotations[:, 25:] = hands.reshape(30, 3)
        made[name] = Motion(rotations, translations, 30.0, name)
    return made


def write_capture(folder, body, made):
    """Write what the cameras see of a body in a skirt."""
    rig, sequences = cameras(), {}
    skirt = skirt_mesh(body)
    for split, name in SEQUENCES.items():
        motion = made[name]
        write_motion(folder / f"{name}.npz", motion, body)
        for frame in range(FRAMES):
            vertices = pose_vertices(body, motion[frame])
            cone = skirt[0] + vertices[skirt[2]].mean(0)
            for camera in rig:
                alpha = torch.maximum(
                    silhouette(vertices, body.faces, camera), silhouette(cone, skirt[1], camera)
                )
                pixels = torch.cat([torch.full((HEIGHT, WIDTH, 3), 0.3), alpha[..., None]], -1)
                # A number in a corner: frames differ even where the person stands still.
                pixels[0, frame, 0] = 1.0
                path = folder / name / camera.name / f"{frame:04d}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray((pixels * 255).round().byte().numpy(), "RGBA").save(path)
        sequences[name] = {"motion": f"{name}.npz", "images": name, "frames": FRAMES, "split": split}
    entries = [
        {
            "name": c.name,
            "K": c.K.tolist(),
            "T_camera_world": c.T_camera_world.tolist(),
            "width": WIDTH,
            "height": HEIGHT,
        }
        for c in rig
    ]
    record = {
        "format": "dsar-capture", "version": 1, "name": "check", "fps": 30.0, "cameras": entries,
        "body": None, "betas": [], "sequences": sequences,
    }  # fmt: skip
    (folder / "capture.json").write_text(json.dumps(record))
    return folder


def skirt_mesh(body):
    """A cone from waist to knees: vertices relative to the hips' middle, faces, vertices of the hips."""
    hips = (body.weights[:, 0] > 0.8).nonzero().squeeze(1)
    angles = torch.arange(24) / 24 * 2 * math.pi
    ring = torch.stack([angles.sin(), torch.zeros(24), angles.cos()], -1)
    top, bottom = 0.16 * ring + torch.tensor([0.0, 0.1, 0.0]), 0.38 * ring - torch.tensor([0.0, 0.4, 0.0])
    k, n = torch.arange(24), (torch.arange(24) + 1) % 24
    faces = torch.cat([torch.stack([k, n, k + 24], 1), torch.stack([n, n + 24, k + 24], 1)])
    return torch.cat([top, bottom]), faces, hips


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("clean"), load_body(), motions())


@pytest.fixture
def folder(clean, tmp_path):
    return shutil.copytree(clean, tmp_path / "spoilt")


def edit_cameras(folder, change):
    record = json.loads((folder / "capture.json").read_text())
    for entry in record["cameras"]:
        for key, value in change(np.array(entry["K"]), np.array(entry["T_camera_world"])).items():
            entry[key] = value.tolist()
    (folder / "capture.json").write_text(json.dumps(record))


def edit_extrinsics(change):
    return lambda folder: edit_cameras(folder, lambda K, T: {"T_camera_world": change(T)})


def edit_intrinsics(change):
    return lambda folder: edit_cameras(folder, lambda K, T: {"K": change(K)})


def edit_images(change):
    def spoil(folder):
        for path in folder.glob("*/cam*/*.png"):
            Image.fromarray(change(np.array(Image.open(path)))).save(path)

    return spoil


def rigid(rotation, translation):
    return np.block([[rotation, translation[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def edit_motion(**changes):
    def spoil(folder):
        for name in SEQUENCES.values():
            with np.load(folder / f"{name}.npz") as file:
                arrays = {key: file[key] for key in file.files}
            arrays |= {key: change(arrays[key]) for key, change in changes.items()}
            np.savez(folder / f"{name}.npz", **arrays)

    return spoil


def write_y_up(folder):
    """Motion whose file has Y up, where AMASS has Z up."""
    body, made = load_body(), motions()
    from dsar.data.motions.files import rotate_motion

    for name, motion in made.items():
        write_motion(folder / f"{name}.npz", rotate_motion(motion, body, layouts.z_up().T), body)


def delay(folder):
    """Images show what was two frames before; the first two are missing."""
    for camera in folder.glob("*/cam*"):
        for frame in range(FRAMES - 1, 1, -1):
            shutil.copy(camera / f"{frame - 2:04d}.png", camera / f"{frame:04d}.png")
        for frame in range(2):
            (camera / f"{frame:04d}.png").unlink()


def swap(folder):
    for name in SEQUENCES.values():
        (folder / name / "cam1").rename(folder / name / "tmp")
        (folder / name / "cam3").rename(folder / name / "cam1")
        (folder / name / "tmp").rename(folder / name / "cam3")


def tilt(folder):
    record = json.loads((folder / "capture.json").read_text())
    T = np.array(record["cameras"][2]["T_camera_world"])
    record["cameras"][2]["T_camera_world"] = (rigid(np.eye(3), np.array([0.25, 0.1, 0.0])) @ T).tolist()
    (folder / "capture.json").write_text(json.dumps(record))


def delay_one(folder):
    """One camera shows what the others saw three frames before; its first three images are missing."""
    for camera in folder.glob("*/cam2"):
        for frame in range(FRAMES - 1, 2, -1):
            shutil.copy(camera / f"{frame - 3:04d}.png", camera / f"{frame:04d}.png")
        for frame in range(3):
            (camera / f"{frame:04d}.png").unlink()


def stutter(folder):
    for frame in (5, 9):
        shutil.copy(folder / f"sway/cam2/{frame - 1:04d}.png", folder / f"sway/cam2/{frame:04d}.png")


def cut_short(folder):
    path = folder / "turn/cam1/0007.png"
    path.write_bytes(path.read_bytes()[:200])


FAULTS = {
    "camera_to_world": edit_extrinsics(np.linalg.inv),
    "rotation_transposed": edit_extrinsics(lambda T: rigid(T[:3, :3].T, T[:3, 3])),
    "camera_centers": edit_extrinsics(lambda T: rigid(T[:3, :3], -T[:3, :3].T @ T[:3, 3])),
    "opengl_axes": edit_extrinsics(lambda T: np.diag([1.0, -1.0, -1.0, 1.0]) @ T),
    "pytorch3d_axes": edit_extrinsics(lambda T: np.diag([-1.0, -1.0, 1.0, 1.0]) @ T),
    "cameras_in_millimetres": edit_extrinsics(lambda T: rigid(T[:3, :3], 1000 * T[:3, 3])),
    "motion_in_millimetres": edit_motion(trans=lambda trans: 1000 * trans),
    "motion_turned_X+90": write_y_up,
    "frame_offset_-2": delay,
    "intrinsics_times_2": edit_intrinsics(lambda K: K * np.array([[2.0], [2.0], [1.0]])),
    "intrinsics_times_0.5": edit_intrinsics(lambda K: K * np.array([[0.5], [0.5], [1.0]])),
    "cameras_in_centimetres": edit_extrinsics(lambda T: rigid(T[:3, :3], 100 * T[:3, 3])),
    "half_pixel_+0.5": edit_intrinsics(lambda K: K - HALF),
    "half_pixel_-0.5": edit_intrinsics(lambda K: K + HALF),
    "mirrored_images": edit_images(lambda image: image[:, ::-1]),
    "upside_down": edit_images(lambda image: image[::-1, ::-1]),
    "masks_inverted": edit_images(lambda image: np.dstack([image[..., :3], 255 - image[..., 3]])),
    "empty_masks": edit_images(lambda image: np.dstack([image[..., :3], 0 * image[..., 3]])),
    "cameras_swapped": swap,
    "camera_off": tilt,
    "camera_late": delay_one,
    "duplicate_frames": stutter,
    "broken_images": cut_short,
}  # fmt: skip
FATAL = {
    *("masks_inverted", "empty_masks", "broken_images", "camera_to_world", "opengl_axes"),
    *("motion_in_millimetres", "cameras_in_centimetres", "intrinsics_times_2", "intrinsics_times_0.5"),
}


def test_a_clean_capture_passes(clean):
    verdict = check_capture(open_capture(clean))
    assert verdict.findings == []
    assert not verdict.fatal
    for camera in verdict.cameras:
        assert (camera.images, camera.missing) == (2 * FRAMES, 0)
        assert camera.inside > 0.995
        assert 0.5 < camera.iou < 0.95, "a skirt hides what no body fills"
    figures = verdict.figures
    assert figures.divergence["turn"].mmd_squared == pytest.approx(figures.divergence["turn"].mmd ** 2)
    assert sum(figures.fastest_joint_histogram.values()) == 2 * (FRAMES - 1)
    assert figures.disk_bytes == sum(path.stat().st_size for path in clean.rglob("*") if path.is_file())
    json.dumps(verdict.to_json())


@pytest.mark.parametrize("name", FAULTS)
def test_a_seeded_fault_is_named(folder, name):
    FAULTS[name](folder)
    verdict = check_capture(open_capture(folder))
    found = [finding.name for finding in verdict.findings]
    assert name in found, verdict.findings
    # Nothing else is accused, but that the first frames are missing where all images are late.
    assert set(found) - {"unseen_frames"} == {name}
    assert ("unseen_frames" in found) == (name == "frame_offset_-2")
    if name in FATAL:
        assert verdict.fatal
    if name in ("frame_offset_-2", "half_pixel_+0.5", "duplicate_frames", "camera_off"):
        assert not verdict.fatal


def test_a_camera_is_named_whose_images_are_anothers(folder):
    swap(folder)
    findings = check_capture(open_capture(folder)).findings
    assert {finding.what.split(":")[0] for finding in findings} == {
        "the images of cam1 are those of cam3",
        "the images of cam3 are those of cam1",
    }


@pytest.mark.parametrize(("added", "name"), [(1.0, "mean_hands"), (-1.0, "flat_hands")])
def test_a_wrong_hand_convention_is_named(tmp_path, added, name):
    layouts.body_with_hands(tmp_path / "body.npz")
    with np.load(tmp_path / "body.npz") as file:
        mean = torch.from_numpy(np.concatenate([file["hands_meanl"], file["hands_meanr"]])).float()
    pose = 0.2 * torch.randn(90, generator=torch.Generator().manual_seed(0))
    body = load_body(tmp_path / "body.npz")
    folder = write_capture(tmp_path, body, motions(pose))
    record = json.loads((folder / "capture.json").read_text())
    (folder / "capture.json").write_text(json.dumps(record | {"body": "body.npz"}))
    assert check_capture(open_capture(folder)).findings == []
    for sequence, motion in motions(pose + added * mean).items():
        write_motion(folder / f"{sequence}.npz", motion, body)
    assert [finding.name for finding in check_capture(open_capture(folder)).findings] == [name]


def test_a_jump_is_named_with_its_frame(folder):
    def jump(trans):
        trans = trans.copy()
        trans[9:] += 2.0
        return trans

    edit_motion(trans=jump)(folder)
    findings = check_capture(open_capture(folder)).findings
    jumps = [finding.what for finding in findings if finding.name == "jumps"]
    assert jumps == [
        f"sequence {name}: the body jumps at frame 9; cut it there" for name in SEQUENCES.values()
    ]


def test_images_that_do_not_meet_the_motion_are_no_clean_capture(folder):
    for path in folder.glob("*/cam*/*.png"):
        if not 4 <= int(path.stem) <= 6:
            path.unlink()
    verdict = check_capture(open_capture(folder))
    assert [finding.name for finding in verdict.findings] == ["unseen_frames", "unseen_frames"]
    assert "no camera has an image of 9 of 12 frames: 0, 1, 2, 3, 7 and 4 more" in verdict.findings[0].what
    assert all(camera.inside > 0.99 for camera in verdict.cameras)


def test_the_body_is_drawn_over_the_images(clean):
    capture = open_capture(clean)
    rows, columns = draw_overlays(capture)
    assert list(rows) == [camera.name for camera in capture.cameras]
    assert all(len(images) == len(columns) for images in rows.values())
    summary = rows["cam0"][0]
    assert summary.shape == (HEIGHT, WIDTH, 3)
    orange = (summary[..., 0] > summary[..., 2].astype(int) + 40).mean()
    assert 0.03 < orange < 0.4


def test_the_command_prints_writes_and_exits(clean, folder, tmp_path, capsys):
    main(
        [
            "check",
            str(clean),
            "--sheet",
            str(tmp_path / "a.png"),
            "--json",
            str(tmp_path / "a.json"),
            "--progress",
            "none",
        ]
    )
    said = capsys.readouterr().out
    assert f"cam0             {2 * FRAMES} images, 0 missing" in said
    assert "nothing is wrong" in said
    found = json.loads((tmp_path / "a.json").read_text())
    assert (found["fatal"], found["findings"], len(found["cameras"])) == (False, [], 4)
    assert found["demo_preset"]["worker_bytes"] > 1e8
    with Image.open(tmp_path / "a.png") as sheet:
        assert sheet.size[0] > 8 * WIDTH * 0.8
    FAULTS["opengl_axes"](folder)
    with pytest.raises(SystemExit) as left:
        main(["check", str(folder), "--sheet", str(tmp_path / "b.png"), "--progress", "none"])
    assert left.value.code == 2
    assert "CANNOT TRAIN opengl_axes: the cameras' axes are OpenGL's" in capsys.readouterr().out


def test_broken_images_do_not_stop_the_sheet(folder):
    for path in folder.glob("sway/cam1/*.png"):
        path.write_bytes(path.read_bytes()[:200])
    rows, _ = draw_overlays(open_capture(folder))
    assert (rows["cam1"][0] == 255).all()
    assert not (rows["cam0"][0] == 255).all()


def test_a_capture_without_a_readable_image_is_refused(folder):
    for path in folder.glob("*/cam*/*.png"):
        data = path.read_bytes()
        path.write_bytes(data[:-40])
    with pytest.raises(CaptureError, match="none of its 96 images can be read"):
        check_capture(open_capture(folder))
