"""The skeleton of SMPL-X, which every body and motion uses."""

_FINGER_NAMES = ("index", "middle", "pinky", "ring", "thumb")

JOINT_NAMES: tuple[str, ...] = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2"),
    *("left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar"),
    *("right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow"),
    *("left_wrist", "right_wrist", "jaw", "left_eye_smplhf", "right_eye_smplhf"),
    *(f"{side}_{name}{k}" for side in ("left", "right") for name in _FINGER_NAMES for k in (1, 2, 3)),
)
"""The 55 joints of SMPL-X in their published order; every body and motion uses it."""

PARENTS: tuple[int, ...] = (
    *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15),
    *(20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38),
    *(21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53),
)
"""Parent of each joint in `JOINT_NAMES`; -1 at the pelvis."""

HEAD = JOINT_NAMES.index("head")
FACE_JOINTS = range(JOINT_NAMES.index("jaw"), JOINT_NAMES.index("jaw") + 3)
"""Jaw and eyes: the joints that SMPL-X has and SMPL-H has not."""
