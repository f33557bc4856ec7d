"""Writes a sequence of a capture in the layouts of public data sets, so that readers have a known truth.

Colours where the mask is empty become a green wall: readers must not look at them. `turn` carries our world
to the one in which the files are written.
"""

import csv
import io
import json
import pickle
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from dsar.body.files import EMBEDDED_BODY
from dsar.data.motions.files import rotate_motion
from dsar.geometry.rotations import axis_angle_from_matrix

_JPG = {"quality": 100, "subsampling": 0}
WALL = (30, 200, 60)
SERIALS = ("22010708", "22010710", "22010716", "22010718", "22053923", "22053925", "22070928", "22139905")


def write_avatarrex(capture, sequence, folder, turn=None, distortion=(0.0,) * 5):
    """Return the cameras' names, in the capture's order."""
    names = SERIALS[: len(capture.cameras)]
    record = {
        name: entry | {"distCoeff": list(distortion)} for name, entry in _opencv(capture, names, turn).items()
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "calibration_full.json").write_text(json.dumps(record))
    for index, name in enumerate(names):
        for frame in range(len(capture.motions[sequence])):
            image = capture.image(sequence, frame, index)
            _save_jpg(folder / name / f"{frame:08d}.jpg", on_wall(image))
            _save_jpg(folder / name / "mask" / "pha" / f"{frame:08d}.jpg", image[..., 3])
    _write_smplx(capture, sequence, folder, turn)
    (folder / "missing_img_files.txt").write_text("")
    return names


def write_thuman4(capture, sequence, folder, turn=None):
    """Return the cameras' names, in the capture's order."""
    names = [f"cam{index:02d}" for index in range(len(capture.cameras))]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "calibration.json").write_text(json.dumps(_opencv(capture, names, turn)))
    for index, name in enumerate(names):
        for frame in range(len(capture.motions[sequence])):
            image = capture.image(sequence, frame, index)
            _save_jpg(folder / "images" / name / f"{frame:08d}.jpg", on_wall(image))
            _save_jpg(folder / "masks" / name / f"{frame:08d}.jpg", image[..., 3])
    _write_smplx(capture, sequence, folder, turn)
    for name in ("missing_img_files.txt", "missing_msk_files.txt"):
        (folder / name).write_text("")
    return names


def write_actorshq(capture, sequence, folder, turn=None):
    """Return the cameras' names, in the capture's order."""
    names = [f"Cam{index + 1:03d}" for index in range(len(capture.cameras))]
    (folder / "4x").mkdir(parents=True, exist_ok=True)
    with (folder / "4x" / "calibration.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow("name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py".split(","))
        for name, camera in zip(names, capture.cameras, strict=True):
            transform = _filed(camera, turn)
            rotation = axis_angle_from_matrix(transform[:3, :3].T)
            center = -transform[:3, :3].T @ transform[:3, 3]
            w, h, K = camera.width, camera.height, camera.K.double()
            shares = [float(K[0, 0]) / w, float(K[1, 1]) / h, float(K[0, 2]) / w, float(K[1, 2]) / h]
            writer.writerow([name, w, h, *rotation.tolist(), *center.tolist(), *shares])
    for index, name in enumerate(names):
        for frame in range(len(capture.motions[sequence])):
            image = capture.image(sequence, frame, index)
            _save_jpg(folder / "4x" / "rgbs" / name / f"{name}_rgb{frame:06d}.jpg", on_wall(image))
            path = folder / "4x" / "masks" / name / f"{name}_mask{frame:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(image[..., 3]).save(path)
    _write_smplx(capture, sequence, folder, turn)
    return names


def write_dress(capture, sequences, folder, turn=None, *, hands, scans=False):
    """Write each sequence as a take; return the cameras' names.

    `hands` are components and means of the body file. With `scans`, each frame gets the posed body as a scan,
    textured by height.
    """
    names = [f"{24 * index + 4:04d}" for index in range(len(capture.cameras))]
    for number, sequence in enumerate(sequences, 1):
        take, motion = folder / f"Take{number}", capture.motions[sequence]
        frames = [f"{frame + 11:05d}" for frame in range(len(motion))]
        _dump(
            take / "basic_info.pkl",
            {"scan_frames": frames, "rotation": None, "offset": None, "gender": "neutral"},
        )
        cameras = {
            name: {
                "intrinsics": np.array(entry["K"]).reshape(3, 3),
                "extrinsics": np.column_stack([np.array(entry["R"]).reshape(3, 3), entry["T"]]),
            }
            for name, entry in _opencv(capture, names, turn).items()
        }
        _dump(take / "Capture" / "cameras.pkl", cameras)
        for index, name in enumerate(names):
            for frame, label in enumerate(frames):
                image = capture.image(sequence, frame, index)
                for kind, pixels in (("images/capture", on_wall(image)), ("masks/mask", image[..., 3])):
                    path = take / "Capture" / name / f"{kind}-f{label}.png"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    Image.fromarray(pixels).save(path)
        _write_fits(capture, motion, take, frames, turn, hands)
        if scans:
            _write_scans(capture, motion, take, frames, turn)
    return names


def body_with_hands(path):
    """Write the embedded body with hands' components and means, as SMPL-X's file has; return both."""
    generator = np.random.default_rng(0)
    components = np.stack([np.linalg.qr(generator.standard_normal((45, 45)))[0] for _ in range(2)])
    # A mean that twelve components reach: so a flat hand has them.
    means = np.einsum("sk,skc->sc", 0.5 * generator.standard_normal((2, 12)), components[:, :12])
    with np.load(EMBEDDED_BODY) as file:
        used = (
            "v_template",
            "shapedirs",
            "weights",
            "kintree_table",
            "f",
            "vt",
            "ft",
            "j_template",
            "j_shapedirs",
        )
        arrays = {key: file[key] for key in used}
    keys = {"hands_componentsl": components[0], "hands_componentsr": components[1]}
    np.savez(path, **arrays, **keys, hands_meanl=means[0], hands_meanr=means[1])
    return components, means


def _filed(camera, turn):
    transform = camera.T_camera_world.double().clone()
    if turn is not None:
        transform[:3, :3] = transform[:3, :3] @ turn.double().T
    return transform


def _opencv(capture, names, turn):
    record = {}
    for name, camera in zip(names, capture.cameras, strict=True):
        transform, K = _filed(camera, turn), camera.K.double().clone()
        # OpenCV's pixel centres are whole numbers.
        K[:2, 2] -= 0.5
        record[name] = {
            "K": K.flatten().tolist(),
            "R": transform[:3, :3].flatten().tolist(),
            "T": transform[:3, 3].tolist(),
            "imgSize": [camera.width, camera.height],
        }
    return record


def _turned(capture, motion, turn):
    return motion if turn is None else rotate_motion(motion, capture.body, turn)


def _write_smplx(capture, sequence, folder, turn):
    motion = _turned(capture, capture.motions[sequence], turn)
    rotations, frames = motion.rotations.numpy(), len(motion)
    np.savez(
        folder / "smpl_params.npz",
        betas=np.zeros((1, 10), np.float32),
        global_orient=rotations[:, 0],
        transl=motion.translations.numpy(),
        body_pose=rotations[:, 1:22].reshape(frames, -1),
        jaw_pose=rotations[:, 22],
        expression=np.zeros((frames, 10), np.float32),
        left_hand_pose=rotations[:, 25:40].reshape(frames, -1),
        right_hand_pose=rotations[:, 40:55].reshape(frames, -1),
    )


def _write_fits(capture, motion, take, frames, turn, hands):
    components, means = hands
    motion = _turned(capture, motion, turn)
    for frame, label in enumerate(frames):
        rotations = motion.rotations[frame].numpy()
        flat = np.stack([rotations[25:40].ravel(), rotations[40:55].ravel()])
        shares = np.einsum("sc,skc->sk", flat - means, components[:, :12])
        fit = {
            "global_orient": rotations[0],
            "body_pose": rotations[1:22].ravel(),
            "transl": motion.translations[frame].numpy(),
            "betas": np.zeros(10, np.float32),
            "jaw_pose": rotations[22],
            "leye_pose": rotations[23],
            "reye_pose": rotations[24],
            "expression": np.zeros(10, np.float32),
            "left_hand_pose": shares[0],
            "right_hand_pose": shares[1],
        }
        _dump(take / "SMPLX" / f"mesh-f{label}_smplx.pkl", fit)


def _write_scans(capture, motion, take, frames, turn):
    from dsar.body.skinning import pose_vertices

    body = capture.body
    for frame, label in enumerate(frames):
        vertices = pose_vertices(body, _turned(capture, motion, turn)[frame]).numpy()
        height = body.vertices[:, 1]
        v = ((height - height.min()) / (height.max() - height.min())).numpy()
        mesh = {
            "vertices": vertices,
            "faces": body.faces.numpy(),
            "normals": np.zeros_like(vertices),
            "uvs": np.stack([np.full_like(v, 0.5), v], 1),
        }
        _dump(take / "Meshes_pkl" / f"mesh-f{label}.pkl", mesh)
        _dump(take / "Semantic" / "labels" / f"label-f{label}.pkl", {"scan_labels": scan_labels(body)})
        # Row 0 of the texture is v = 0: the feet are red, the head is blue.
        ramp = np.linspace(0, 255, 64).round().astype(np.uint8)
        texture = np.zeros((64, 64, 3), np.uint8)
        texture[..., 0], texture[..., 2] = ramp[::-1, None], ramp[:, None]
        _dump(take / "Meshes_pkl" / f"atlas-f{label}.pkl", texture)


def scan_labels(body):
    """What a scan of the body is labelled as: lower garment between the knees and the hips, else skin."""
    height, joints = body.vertices[:, 1], body.joints[:, 1]
    return np.where((height > joints[4]) & (height < joints[0]), 4, 0)


def _dump(path: Path, content) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(content))


def on_wall(image):
    """The colours of an image where its mask is not empty, a green wall elsewhere."""
    return np.where(image[..., 3:] > 0, image[..., :3], np.uint8(WALL))


def through_jpg(pixels):
    """What is left of pixels that were written as a JPEG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", **_JPG)
    return np.asarray(Image.open(buffer))


def _save_jpg(path: Path, pixels) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **_JPG)


def z_up():
    """Return the turn to a world with Z up."""
    return torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
