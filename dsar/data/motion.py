"""Motion files: AMASS and SMPL-X .npz and .bvh to our `Motion`, .npz back, and changes of frame rate.

The .npz have Z up and the axis-angles of SMPL-X, SMPL-H or SMPL; a `Motion` has Y up and SMPL-X's 55
joints. Their shape coefficients are not read: the avatar moves with its own shape.
"""

import dataclasses
import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.data.bvh import read_bvh
from dsar.data.poses import read_arrays, read_poses, read_rate
from dsar.errors import MotionError
from dsar.geometry.rates import exact_rate
from dsar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from dsar.types import Body, Motion

EMBEDDED_MOTIONS = Path(__file__).parent / "embedded_motion"
"""Clips that come with the package, from the CMU motion capture database (mocap.cs.cmu.edu)."""

_Y_UP_FROM_Z_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))


def read_motion(path: Path, body: Body) -> Motion:
    """Return the motion of a file in the Y-up world, float32.

    Joints that the file lacks stay at rest.

    Args:
        path: an AMASS or SMPL-X .npz with `poses` (or its parts), `trans` and a frame rate, Z up, radians,
            metres; or a .bvh on CMU's skeleton (`dsar.data.bvh`).
        body: the body that will move: turning the world turns it about its pelvis.

    Raises:
        MotionError: the file is missing, unreadable, incomplete, empty or not finite.
    """
    if path.suffix == ".bvh":
        return read_bvh(path, body)
    if path.suffix != ".npz":
        raise MotionError(
            f"motion file {path}: expected an AMASS or SMPL-X .npz or a .bvh, found {path.suffix!r}"
        )
    arrays = read_arrays(path)
    rotations, translations = read_poses(path, arrays)
    z_up = Motion(rotations, translations, read_rate(path, arrays), path.stem)
    return turn_motion(z_up, body, torch.tensor(_Y_UP_FROM_Z_UP))


def write_motion(path: Path, motion: Motion, body: Body) -> None:
    """Write a motion as AMASS does for SMPL-X (Z up), so that other tools read it too.

    Args:
        path: the .npz file; replaced whole or not at all.
        motion: in the Y-up world.
        body: the body that moves.
    """
    z_up = turn_motion(motion, body, torch.tensor(_Y_UP_FROM_Z_UP).T)
    temporary = path.with_name(f".{path.stem}.tmp.npz")
    np.savez_compressed(
        temporary,
        poses=z_up.rotations.flatten(1).numpy(),
        trans=z_up.translations.numpy(),
        betas=np.zeros(16, np.float32),
        gender=np.array("neutral"),
        surface_model_type=np.array("smplx"),
        mocap_frame_rate=np.array(motion.fps),
    )
    os.replace(temporary, path)


def turn_motion(motion: Motion, body: Body, rotation: Float[Tensor, "3 3"]) -> Motion:
    """Return a motion whose posed vertices are the given motion's, turned about the world's origin."""
    turn = rotation.to(motion.rotations)
    pelvis = body.joints[0].to(motion.translations)
    roots = axis_angle_from_matrix(turn @ matrix_from_axis_angle(motion.rotations[:, :1]))
    return dataclasses.replace(
        motion,
        rotations=torch.cat([roots, motion.rotations[:, 1:]], 1),
        translations=(motion.translations + pelvis) @ turn.T - pelvis,
    )


def resample(motion: Motion, fps: float) -> Motion:
    """Return a motion at another frame rate, from its first frame to at most its last.

    Rotations go from key to key at constant angular velocity (slerp), translations in a line.
    """
    if not 0 < fps < float("inf"):
        raise MotionError(f"motion {motion.name}: cannot be resampled to {fps} frames per second")
    last, step = len(motion) - 1, float(exact_rate(motion.fps) / exact_rate(fps))
    # A millionth of a frame forgives the rounding of e.g. 30 / 23.976.
    times = torch.arange(int(last / step + 1e-6) + 1, dtype=torch.float64) * step
    before = times.floor().long().clamp(max=last)
    after = (before + 1).clamp(max=last)
    part = (times - before).to(motion.rotations)[:, None]
    start, end = (matrix_from_axis_angle(motion.rotations[frames]) for frames in (before, after))
    change = axis_angle_from_matrix(start.mT @ end) * part[..., None]
    rotations = axis_angle_from_matrix(start @ matrix_from_axis_angle(change))
    translations = torch.lerp(motion.translations[before], motion.translations[after], part)
    return dataclasses.replace(motion, rotations=rotations, translations=translations, fps=fps)
