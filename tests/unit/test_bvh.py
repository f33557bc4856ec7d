"""Motion capture on CMU's skeleton moves our body: limbs point where the clip's do."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dsar.body.files import load_body
from dsar.body.model import JOINT_NAMES
from dsar.body.skinning import forward_kinematics
from dsar.data.bvh import COUNTERPARTS
from dsar.data.motion import read_motion
from dsar.errors import MotionError

# CMU's hierarchy: joint, parent, rest offset in its unit. Legs are splayed, arms level.
SKELETON = [
    ("Hips", None, (0, 0, 0)),
    *((f"{s}HipJoint", "Hips", (0, 0, 0)) for s in ("L", "R")),
    ("LeftUpLeg", "LHipJoint", (1.65, -1.8, 0.6)),
    ("RightUpLeg", "RHipJoint", (-1.6, -1.8, 0.6)),
    *((f"{s}Leg", f"{s}UpLeg", (2.5 * x, -6.8, 0)) for s, x in (("Left", 1), ("Right", -1))),
    *((f"{s}Foot", f"{s}Leg", (2.6 * x, -7.1, 0)) for s, x in (("Left", 1), ("Right", -1))),
    *((f"{s}ToeBase", f"{s}Foot", (0.2 * x, -0.5, 2.1)) for s, x in (("Left", 1), ("Right", -1))),
    ("LowerBack", "Hips", (0, 0, 0)),
    ("Spine", "LowerBack", (0, 2.1, -0.1)),
    ("Spine1", "Spine", (0, 2.1, 0)),
    ("Neck", "Spine1", (0, 0, 0)),
    ("Head", "Neck", (0, 1.8, 0.3)),
    *((f"{s}Shoulder", "Spine1", (0, 0, 0)) for s in ("Left", "Right")),
    *((f"{s}Arm", f"{s}Shoulder", (3.4 * x, 0.9, -0.2)) for s, x in (("Left", 1), ("Right", -1))),
    *((f"{s}ForeArm", f"{s}Arm", (5 * x, 0, 0)) for s, x in (("Left", 1), ("Right", -1))),
    *((f"{s}Hand", f"{s}ForeArm", (3.7 * x, 0, 0)) for s, x in (("Left", 1), ("Right", -1))),
]
LIMBS = [
    (f"{side}_{start}", f"{side}_{end}")
    for side in ("left", "right")
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
]


def write_bvh(path, frames, positions, angles, *, names=None, seconds="0.0083333"):
    """Write angles in degrees [f, joints, (z, y, x)] and root positions in the order of SKELETON."""
    children = {name: [other for other, parent, _ in SKELETON if parent == name] for name, _, _ in SKELETON}
    offsets, order = {name: offset for name, _, offset in SKELETON}, []

    def joint(name, depth):
        order.append(name)
        pad = "\t" * depth
        lines = [f"{pad}{'JOINT' if depth else 'ROOT'} {(names or {}).get(name, name)}", pad + "{"]
        lines.append(f"{pad}\tOFFSET {' '.join(map(str, offsets[name]))}")
        place = "Xposition Yposition Zposition " if not depth else ""
        lines.append(f"{pad}\tCHANNELS {3 if depth else 6} {place}Zrotation Yrotation Xrotation")
        for child in children[name]:
            lines += joint(child, depth + 1)
        if not children[name]:
            lines += [f"{pad}\tEnd Site", pad + "\t{", f"{pad}\t\tOFFSET 0 0 1", pad + "\t}"]
        return [*lines, pad + "}"]

    lines = ["HIERARCHY", *joint("Hips", 0), "MOTION", f"Frames: {frames}", f"Frame Time: {seconds}"]
    column = [[name for name, _, _ in SKELETON].index(name) for name in order]
    for place, turns in zip(positions, angles, strict=True):
        numbers = [*place.tolist(), *turns[column].ravel().tolist()]
        lines.append(" ".join(f"{number:.6f}" for number in numbers))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def clip():
    rng = np.random.default_rng(0)
    frames = 6
    positions, angles = rng.uniform(-5, 5, (frames, 3)), rng.uniform(-70, 70, (frames, len(SKELETON), 3))
    return positions + np.array([0, 17, 0]), angles


def theirs(positions, angles):
    """World places of the clip's joints by name, by SciPy."""
    turns, places = {}, {}
    for index, (name, parent, offset) in enumerate(SKELETON):
        local = Rotation.from_euler("ZYX", angles[:, index], degrees=True)
        turns[name] = local if parent is None else turns[parent] * local
        places[name] = positions if parent is None else places[parent] + turns[parent].apply(offset)
    return places


def test_limbs_point_where_the_clips_do_and_hips_are_where_its_are(tmp_path, clip):
    body = load_body()
    motion = read_motion(write_bvh(tmp_path / "clip.bvh", 6, *clip), body)
    assert (motion.fps, len(motion), motion.name) == (120.0, 6, "clip")
    transforms = forward_kinematics(body, motion.rotations, motion.translations)
    ours = (transforms[..., :3, :3] @ body.joints[:, :, None])[..., 0] + transforms[..., :3, 3]
    place = {name: ours[:, index].numpy() for index, name in enumerate(JOINT_NAMES)}
    places = theirs(*clip)
    for start, end in LIMBS:
        limb = place[end] - place[start]
        expected = places[COUNTERPARTS[end]] - places[COUNTERPARTS[start]]
        cosine = (limb * expected).sum(-1) / np.linalg.norm(limb, axis=1) / np.linalg.norm(expected, axis=1)
        assert cosine.min() > 0.99999, start
    hips = (place["left_hip"] + place["right_hip"]) / 2
    their_hips = (places["LeftUpLeg"] + places["RightUpLeg"]) / 2
    scale = np.ptp(hips, axis=0) / np.ptp(their_hips, axis=0)
    np.testing.assert_allclose(scale, scale[0], rtol=1e-3)
    np.testing.assert_allclose(hips, their_hips * scale[0], atol=1e-4)
    legs = np.linalg.norm(place["left_knee"] - place["left_ankle"], axis=1) / scale[0]
    assert 5 < legs.mean() < 10
    assert motion.rotations[:, 22:].abs().max() == 0


def test_the_t_pose_in_front_of_a_recording_is_left_out(tmp_path, clip):
    positions, angles = clip
    angles[0] = 0.0
    motion = read_motion(write_bvh(tmp_path / "clip.bvh", 6, positions, angles), load_body())
    assert len(motion) == 5
    angles[1:] = 0.0
    assert len(read_motion(write_bvh(tmp_path / "one.bvh", 1, positions[:1], angles[:1]), load_body())) == 1


def test_world_rotations_do_not_depend_on_the_bodys_rest_arms(tmp_path, clip):
    """A body that rests otherwise ends in the same directions, by other rotations."""
    import dataclasses

    body = load_body()
    moved = body.joints.clone()
    for elbow in (18, 19):
        moved[elbow, 1] -= 0.1
    other = dataclasses.replace(body, joints=moved)
    path = write_bvh(tmp_path / "clip.bvh", 6, *clip)
    found = []
    for each in (body, other):
        motion = read_motion(path, each)
        transforms = forward_kinematics(each, motion.rotations, motion.translations)
        places = (transforms[..., :3, :3] @ each.joints[:, :, None])[..., 0] + transforms[..., :3, 3]
        found.append(torch.nn.functional.normalize(places[:, 18] - places[:, 16], dim=-1))
    assert torch.allclose(*found, atol=1e-4)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("MOTION", "", "has no MOTION"),
        ("Frames: 6", "Frames: 7", "has 6 frames, expected 7"),
        ("Frames: 6", "Frames: x", "cannot be read as .bvh"),
        ("0.0083333", "0", "not a finite number above"),
        ("OFFSET 0 2.1 0\n", "OFFSET 0 2.1\n", "OFFSET of three numbers"),
        ("JOINT LeftLeg", "JOINT LeftShin", "lacks the joints LeftLeg; it has Hips"),
        ("Xposition Yposition Zposition", "Xscale Yscale Zscale", "its root has no position"),
    ],
)
def test_a_broken_clip_is_refused_with_its_name_and_fault(tmp_path, clip, old, new, message):
    path = write_bvh(tmp_path / "broken.bvh", 6, *clip)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(MotionError, match=message) as caught:
        read_motion(path, load_body())
    assert str(path) in str(caught.value)


def test_a_short_line_and_a_value_that_is_not_finite_are_refused_with_their_frame(tmp_path, clip):
    path = write_bvh(tmp_path / "broken.bvh", 6, *clip)
    lines = path.read_text().splitlines()
    for change, message in (
        (lines[-2].rsplit(" ", 1)[0], "frame 4 has .* numbers, expected"),
        ("nan" + lines[-2][lines[-2].index(" ") :], "frame 4 is not a finite number"),
    ):
        path.write_text("\n".join([*lines[:-2], change, lines[-1]]))
        with pytest.raises(MotionError, match=message):
            read_motion(path, load_body())
    with pytest.raises(MotionError, match="no such file"):
        read_motion(tmp_path / "none.bvh", load_body())
