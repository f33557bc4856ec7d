"""Motion capture on CMU's skeleton moves our body: limbs point where the clip's do."""

import re

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dsar.body.files import load_body
from dsar.body.model import JOINT_NAMES
from dsar.body.skinning import forward_kinematics
from dsar.data.motions.files import read_motion
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
WORDS = {
    "hip": "UpLeg",
    "knee": "Leg",
    "ankle": "Foot",
    "shoulder": "Arm",
    "elbow": "ForeArm",
    "wrist": "Hand",
}
COUNTERPARTS = {f"{s}_{our}": s.capitalize() + word for s in ("left", "right") for our, word in WORDS.items()}


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
        ("Frames: 6", "Frames: -6", "has 6 frames, expected -6"),
        ("0.0083333", "30", "frame time 30 .* below one second; say its frames per second with --motion-fps"),
        ("CHANNELS 3 Z", "CHANNELS 2 Z", "joint LHipJoint announces 2 channels and names 3"),
        ("CHANNELS 3 Zrotation", "CHANNELS 3 Zrotating", "LHipJoint has channels Zrotating"),
        ("CHANNELS 3 Zrotation", "CHANNELS 3 Xrotation", "LHipJoint has .* expected each axis once"),
        ("}\nMOTION", "MOTION", "the brace of the joint Hips is not closed"),
        ("}\nMOTION", "}\n}\nMOTION", "a brace too many is closed"),
        ("JOINT LHipJoint", "ROOT LHipJoint", "several roots, Hips and LHipJoint"),
        ("Frames: 6", "Frames: x", "cannot be read as .bvh"),
        ("0.0083333", "0", "not a finite number above"),
        ("OFFSET 0 2.1 0\n", "OFFSET 0 2.1\n", "OFFSET of three numbers"),
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


ENCODINGS = {
    "byte-order mark and CRLF": lambda text: b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode(),
    "UTF-16": lambda text: text.encode("utf-16"),
    "CR alone": lambda text: text.replace("\n", "\r").encode(),
    "Latin-1 names": lambda text: text.replace("LHipJoint", "Hüfte").encode("latin-1"),
    "braces behind names": lambda text: re.sub(r"\n\s*{", " {", text).encode(),
    "small letters": lambda text: text.replace("JOINT", "joint").replace("CHANNELS", "Channels").encode(),
    "a prefix": lambda text: re.sub("(ROOT|JOINT) ", r"\1 Müller:", text).encode(),
}


@pytest.mark.parametrize("how", ENCODINGS)
def test_encodings_and_line_ends_do_not_change_a_motion(tmp_path, clip, how):
    plain = write_bvh(tmp_path / "plain.bvh", 6, *clip)
    other = tmp_path / "Größe 動き.BVH"
    other.write_bytes(ENCODINGS[how](plain.read_text()))
    expected, motion = (read_motion(path, load_body()) for path in (plain, other))
    assert torch.equal(motion.rotations, expected.rotations)
    assert torch.equal(motion.translations, expected.translations)


def test_a_skeleton_without_bones_is_refused_and_one_with_them_in_its_channels_is_not(tmp_path, clip):
    """Positions of all joints by frame, in place of OFFSETs that are zero."""
    plain = write_bvh(tmp_path / "plain.bvh", 6, *clip)
    lines, values = plain.read_text().split("MOTION")
    offsets = re.findall(r"OFFSET (.*)\n\s*CHANNELS", lines)
    empty = re.sub(r"OFFSET .*(\n\s*CHANNELS)", r"OFFSET 0 0 0\1", lines)
    path = tmp_path / "bones.bvh"
    path.write_text(empty + "MOTION" + values)
    with pytest.raises(MotionError, match=r"bones\.bvh: all offsets are zero, so the file has no bones"):
        read_motion(path, load_body())
    empty = empty.replace("CHANNELS 3 ", "CHANNELS 6 Xposition Yposition Zposition ")
    head, *rows = values.strip().split("\n")[0:1], *values.strip().split("\n")[2:]
    moved = []
    for row in rows:
        numbers = row.split()
        joints = [numbers[3 * joint + 3 : 3 * joint + 6] for joint in range(len(offsets))]
        places = [" ".join(numbers[:3]), *offsets[1:]]
        moved.append(
            " ".join(f"{place} {' '.join(turn)}" for place, turn in zip(places, joints, strict=True))
        )
    path.write_text(empty + "MOTION\n" + head[0] + "\nFrame Time: .0083333\n" + "\n".join(moved))
    motion, expected = (read_motion(each, load_body()) for each in (path, plain))
    assert torch.allclose(motion.rotations, expected.rotations, atol=1e-5)
    assert torch.allclose(motion.translations, expected.translations, atol=1e-5)


def test_scales_are_left_out_where_they_are_constant_and_refused_where_they_change(tmp_path, clip, caplog):
    plain = write_bvh(tmp_path / "plain.bvh", 6, *clip)
    *lines, last = plain.read_text().replace("CHANNELS 6 Xpos", "CHANNELS 7 Xscale Xpos").splitlines()
    path = tmp_path / "scaled.bvh"
    frames = [*lines[-5:], last]
    path.write_text("\n".join([*lines[:-5], *(f"1.0 {frame}" for frame in frames)]))
    expected = read_motion(plain, load_body())
    assert torch.equal(read_motion(path, load_body()).rotations, expected.rotations)
    assert "1 scale channels, all constant, are left out" in caplog.text
    path.write_text("\n".join([*lines[:-5], *(f"{number}.0 {frame}" for number, frame in enumerate(frames))]))
    with pytest.raises(MotionError, match="joints change their scale"):
        read_motion(path, load_body())


def test_frames_beyond_those_announced_are_left_out_and_said(tmp_path, clip, caplog):
    path = write_bvh(tmp_path / "long.bvh", 6, *clip)
    path.write_text(path.read_text().replace("Frames: 6", "Frames: 5"))
    assert len(read_motion(path, load_body())) == 5
    assert "announces 5 frames and has 6; the last are left out" in caplog.text


def test_a_rest_pose_with_splayed_legs_in_front_of_a_recording_is_left_out(tmp_path, clip):
    """CMU's T-pose turns legs and arms a little and nothing else."""
    positions, angles = clip
    angles[0] = 0.0
    angles[0, 3, 0], angles[0, 4, 0] = -17.0, 17.0
    assert len(read_motion(write_bvh(tmp_path / "clip.bvh", 6, positions, angles), load_body())) == 5


@pytest.mark.parametrize(
    ("seconds", "fps"),
    [
        (".0083333", 120.0),
        ("0.0333667", 30000 / 1001),
        ("0.041708", 24000 / 1001),
        ("0.041667", 24.0),
        ("0.01", 100.0),
    ],
)
def test_the_time_of_a_frame_in_few_digits_is_the_rate_that_is_meant(tmp_path, clip, seconds, fps):
    path = write_bvh(tmp_path / "clip.bvh", 6, *clip, seconds=seconds)
    assert read_motion(path, load_body()).fps == fps
    assert read_motion(path, load_body(), fps=50.0).fps == 50.0
