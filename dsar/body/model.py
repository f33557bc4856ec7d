"""A shaped body at rest: what skinning, texels and renderers read."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

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


@dataclass(frozen=True)
class Body:
    """One person's body in the rest T-pose: Y up, facing +Z, left hand at +X, metres.

    The origin is the file's own (near the pelvis), so the feet are below y = 0.
    """

    vertices: Float[Tensor, "v 3"]
    """Shaped rest vertices."""
    faces: Int[Tensor, "t 3"]
    """Triangles as vertex indices, counter-clockwise seen from outside."""
    joints: Float[Tensor, "j 3"]
    """Shaped rest joints in the order of `JOINT_NAMES`."""
    parents: tuple[int, ...]
    """Parent of each joint, always before its child; -1 at the pelvis."""
    weights: Float[Tensor, "v j"]
    """Skinning weights; every row sums to 1."""
    uv: Float[Tensor, "u 2"]
    """Texture coordinates in [0, 1], origin at the bottom left."""
    uv_faces: Int[Tensor, "t 3"]
    """The same triangles as indices into `uv`."""

    def to(self, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "Body":
        """Return the body on another device, or with its real-valued fields in another precision."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        moved = {
            name: value.to(device=device, dtype=dtype if value.is_floating_point() else None)
            for name, value in fields.items()
            if isinstance(value, Tensor)
        }
        return dataclasses.replace(self, **moved)
