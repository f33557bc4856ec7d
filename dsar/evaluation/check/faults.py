"""The usual mistakes in captures, each with what would mend it: the one that mends best is named."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.body.model import FACE_JOINTS, JOINT_NAMES
from dsar.data.motions.files import rotate_motion
from dsar.evaluation.check.silhouettes import Hypothesis, Mask, silhouette_errors
from dsar.geometry.camera_faults import (
    CALIBRATION_FAULTS,
    HALF_PIXEL_FAULTS,
    CameraChange,
    CameraFault,
    shift_principal_point,
)
from dsar.geometry.rotations import matrix_from_axis_angle
from dsar.types import Camera, Motion

_CLEARER = 0.004
"""How much smaller the mean error must be for a mistake to be named."""
_SURER = 4.0
"""And how many of its standard errors."""
_FEW, _BEST = 6, 4
_SHIFTS = (1, 2, 3, 4, 5, 6, 8, 10, 15)
_HANDS = slice(FACE_JOINTS.stop, len(JOINT_NAMES))
_LEFT, _RIGHT = slice(FACE_JOINTS.stop, FACE_JOINTS.stop + 15), slice(FACE_JOINTS.stop + 15, len(JOINT_NAMES))


@dataclass(frozen=True)
class Fault:
    """What may be wrong."""

    name: str
    """A word for it, stable."""
    remedy: str
    """What the user is to do."""
    undo: Callable[[Hypothesis], Hypothesis]
    """Undoes it."""
    shift: int = 0
    """Frames that images are behind the motion."""


@dataclass(frozen=True)
class Candidate:
    """A mistake, and how much better masks and body agree without it."""

    fault: Fault
    before: float
    """Mean error as it is."""
    after: float
    """Mean error when mended."""


def coarse_faults(R_world_file: Float[Tensor, "3 3"]) -> Iterator[Fault]:
    """Yield what shows in small images.

    Args:
        R_world_file: From the world of the capture's files to ours.
    """
    yield from (_undo_camera_fault(fault, R_world_file) for fault in CALIBRATION_FAULTS)
    for factor, name in ((1e-3, "millimetres"), (1e-2, "centimetres"), (1e3, "kilometres")):
        yield Fault(
            f"motion_in_{name}",
            f"the motion's translations look like {name}: divide them by {1 / factor:g}",
            _of_motions(
                lambda motion, hypothesis, factor=factor: _scaled(motion, hypothesis, factor, R_world_file)
            ),
        )
    for degrees in (90.0, -90.0, 180.0):
        for axis in ("X", "Z") if degrees != 180.0 else ("X", "Y", "Z"):
            yield Fault(
                f"motion_turned_{axis}{degrees:+.0f}",
                f"motion and cameras have different worlds: turn the motion by {degrees:+.0f} degrees about "
                f"{axis} (is one of them Z up?)",
                _of_motions(
                    lambda motion, hypothesis, axis=axis, degrees=degrees: rotate_motion(
                        motion, hypothesis.body, _about(axis, degrees)
                    )
                ),
            )
    for frames in _SHIFTS:
        for shift in (frames, -frames):
            yield Fault(
                f"frame_offset_{shift:+d}",
                f"images show the motion's frame {abs(shift)} {'later' if shift > 0 else 'earlier'}: number "
                "them alike",
                lambda hypothesis: hypothesis,
                shift,
            )


def half_pixel_faults() -> Iterator[Fault]:
    """Yield principal points that are off by half a pixel."""
    yield from (_undo_camera_fault(fault, torch.eye(3)) for fault in HALF_PIXEL_FAULTS)


def hand_faults(hands: Float[Tensor, "2 45"] | None) -> Iterator[Fault]:
    """Yield what shows about the hands only.

    Args:
        hands: Mean poses of the model's hands, left and right; None where the body file has none.
    """
    yield Fault(
        "hands_swapped",
        "left and right hand are exchanged: swap their poses",
        _of_motions(
            lambda motion, _: _with_hands(motion, motion.rotations[:, [*_indices(_RIGHT), *_indices(_LEFT)]])
        ),
    )
    if hands is not None:
        mean = hands.reshape(1, 30, 3)
        for sign, name, what in (
            (
                1.0,
                "flat_hands",
                "were given about the model's mean pose: add the mean (flat_hand_mean=False)",
            ),
            (-1.0, "mean_hands", "have the model's mean pose twice: take it off (flat_hand_mean=True)"),
        ):
            yield Fault(
                name,
                f"the hands' poses {what}",
                _of_motions(
                    lambda motion, _, sign=sign: _with_hands(
                        motion, motion.rotations[:, _HANDS] + sign * mean
                    )
                ),
            )


def find_fault(
    hypothesis: Hypothesis, masks: Sequence[Mask], faults: Iterator[Fault], before: Float[np.ndarray, " m"]
) -> Candidate | None:
    """Return the mistake without which body and masks agree best; None where none is clearly better."""
    # Most guesses are far off, which a few views tell; only the best of them are worth all.
    few = slice(None, None, max(1, len(masks) // _FEW))

    def first_error(fault: Fault) -> float:
        return float(silhouette_errors(fault.undo(hypothesis), masks[few], fault.shift).mean())

    best: Candidate | None = None
    for fault in sorted(faults, key=first_error)[:_BEST]:
        after = silhouette_errors(fault.undo(hypothesis), masks, fault.shift)
        if is_significantly_smaller(before, after) and (best is None or after.mean() < best.after):
            best = Candidate(fault, float(before.mean()), float(after.mean()))
    return best


def is_significantly_smaller(before: Float[np.ndarray, " m"], after: Float[np.ndarray, " m"]) -> bool:
    """Return whether errors of the same views are smaller, by more than chance and by more than a trifle."""
    gain = before - after
    chance = gain.std(ddof=1) / len(gain) ** 0.5 if len(gain) > 1 else np.inf
    return bool(gain.mean() > max(_CLEARER, _SURER * chance))


def control_hypotheses(hypothesis: Hypothesis) -> Iterator[Hypothesis]:
    """Yield readings as far off as half a pixel that no mistake explains: what a better fit alone gains."""
    for x, y in ((0.5, -0.5), (-0.5, 0.5)):
        yield _of_cameras(shift_principal_point(x, y))(hypothesis)


def _undo_camera_fault(fault: CameraFault, R_world_file: Float[Tensor, "3 3"]) -> Fault:
    """Return a camera fault with what undoes it in a hypothesis."""
    (undo,) = fault.changes
    T_world_file = torch.block_diag(R_world_file, torch.ones(1, 1))

    def undo_in_file_world(camera: Camera) -> Camera:
        filed = undo(dataclasses.replace(camera, T_camera_world=camera.T_camera_world @ T_world_file))
        return dataclasses.replace(filed, T_camera_world=filed.T_camera_world @ T_world_file.T)

    change = undo_in_file_world if fault.in_file_world else undo
    return Fault(fault.name, fault.description, _of_cameras(change))


def _of_cameras(change: CameraChange) -> Callable[[Hypothesis], Hypothesis]:
    def undo(hypothesis: Hypothesis) -> Hypothesis:
        return dataclasses.replace(hypothesis, cameras={k: change(c) for k, c in hypothesis.cameras.items()})

    return undo


def _of_motions(change: Callable[[Motion, Hypothesis], Motion]) -> Callable[[Hypothesis], Hypothesis]:
    def undo(hypothesis: Hypothesis) -> Hypothesis:
        return dataclasses.replace(
            hypothesis, motions={k: change(m, hypothesis) for k, m in hypothesis.motions.items()}
        )

    return undo


def _scaled(
    motion: Motion, hypothesis: Hypothesis, factor: float, R_world_file: Float[Tensor, "3 3"]
) -> Motion:
    filed = rotate_motion(motion, hypothesis.body, R_world_file.T)
    return rotate_motion(
        dataclasses.replace(filed, translations=filed.translations * factor), hypothesis.body, R_world_file
    )


def _about(axis: str, degrees: float) -> Float[Tensor, "3 3"]:
    vector = torch.eye(3)["XYZ".index(axis)]
    return matrix_from_axis_angle(vector * torch.tensor(degrees).deg2rad())


def _with_hands(motion: Motion, hands: Float[Tensor, "f 30 3"]) -> Motion:
    rotations = motion.rotations.clone()
    rotations[:, _HANDS] = hands
    return dataclasses.replace(motion, rotations=rotations)


def _indices(part: slice) -> range:
    return range(part.start, part.stop)
