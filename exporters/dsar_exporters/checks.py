"""What every writer asks of its input before it opens a file."""

import re
from collections.abc import Iterator, Sequence
from itertools import pairwise

import torch

from dsar.errors import ExportError
from dsar.types import Camera, Gaussians, GaussianSequence

_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_HARMONICS_COUNTS = (1, 4, 9, 16)
_UNIT = 1e-3
"""How far a quaternion's length may be from 1."""


def check_name(role: str, name: str) -> None:
    """Check that a name is a valid identifier: it becomes a USD prim, an EXR view and a part of file names.

    Raises:
        ExportError: It is not.
    """
    if not _IDENTIFIER.fullmatch(name):
        raise ExportError(
            f"{role}: expected letters, digits and _ (no leading digit), found {name!r}: rename it"
        )


def check_file_name(role: str, name: str) -> None:
    """Check that a name can be the first part of file names.

    Raises:
        ExportError: It is empty or holds a slash.
    """
    if not name or any(separator in name for separator in "/\\"):
        raise ExportError(f"{role}: expected a name without / or \\, found {name!r}: rename it")


def check_cameras(cameras: Sequence[Camera]) -> None:
    """Check that camera names are valid and distinct.

    Raises:
        ExportError: A name is no identifier or is used twice.
    """
    names = [camera.name for camera in cameras]
    for name in names:
        check_name("camera name", name)
    if doubled := {name for name in names if names.count(name) > 1}:
        raise ExportError(f"camera names: expected distinct names, found {sorted(doubled)} twice: rename one")


def check_sequence(sequence: GaussianSequence) -> None:
    """Check what a sequence says about itself, without producing a frame.

    Raises:
        ExportError: No frames, frame numbers that do not ascend, a frame rate that is not positive, or a
            binding of another number of frames.
    """
    frames = sequence.frame_numbers
    if not frames:
        raise ExportError("sequence: expected at least one frame, found none: widen the frame range")
    if any(later <= earlier for earlier, later in pairwise(frames)):
        raise ExportError(
            f"sequence: expected ascending frame numbers, found {list(frames)[:8]}...: sort them"
        )
    if sequence.binding is not None and len(sequence.binding.T_world_rest) != len(frames):
        raise ExportError(
            f"sequence: expected the binding of {len(frames)} frames, found that of "
            f"{len(sequence.binding.T_world_rest)}: cut both alike"
        )
    if not sequence.fps > 0:
        raise ExportError(f"sequence: expected frames per second > 0, found {sequence.fps}")


def checked_frames(sequence: GaussianSequence) -> Iterator[tuple[int, Gaussians]]:
    """Yield (frame number, Gaussians as float32 on the CPU), one frame in memory at a time.

    Raises:
        ExportError: A frame has another number of Gaussians than the sequence says, another number of
            harmonics than the first frame, or a value that is not finite or not what its field holds.
    """
    harmonics_count, last_finite = None, None
    for frame, gaussians in sequence:
        if len(gaussians) != sequence.num_gaussians:
            raise ExportError(
                f"frame {frame}: expected {sequence.num_gaussians} Gaussians, found {len(gaussians)}: "
                "an animated asset needs the same Gaussians in every frame"
            )
        count = gaussians.harmonics.shape[1]
        expected = _HARMONICS_COUNTS if harmonics_count is None else (harmonics_count,)
        if count not in expected:
            raise ExportError(f"frame {frame}: expected {expected} harmonics per Gaussian, found {count}")
        harmonics_count = count
        frame_values = gaussians.map(lambda values: values.detach().cpu().to(torch.float32).contiguous())
        _check_finite(frame, frame_values, last_finite)
        _check_ranges(frame, frame_values)
        last_finite = frame
        yield frame, frame_values


def _check_finite(frame: int, gaussians: Gaussians, last_finite: int | None) -> None:
    """Check a frame's values; `last_finite` is the last frame before it, whose values were finite, if any."""
    # A sum is finite only where all its terms are; the other way round it may overflow.
    suspects = {name: values for name, values in vars(gaussians).items() if not values.sum().isfinite()}
    broken = {name: int((~values.isfinite()).sum()) for name, values in suspects.items()}
    faults = [f"{name}, found {count} values that are not" for name, count in broken.items() if count]
    if not faults:
        return
    # The sequence does not say where it comes from: name what it can be, and what speaks for which.
    cause = (
        "the checkpoint or the motion holds such values, or the network made them at once: look at both"
        if last_finite is None
        else f"frame {last_finite} is finite: the motion holds such values there, or the network made them "
        f"on the way: look at the motion, or export frames up to {last_finite}"
    )
    raise ExportError(f"frame {frame}: expected finite {'; finite '.join(faults)}: {cause}")


def _check_ranges(frame: int, gaussians: Gaussians) -> None:
    """Check that the values are physical: no logits, no logarithms, no quaternions of another length."""
    if not len(gaussians):
        return
    lengths, scales, opacities = gaussians.rotations.norm(dim=-1), gaussians.scales, gaussians.opacities
    for quantity, values, low, high in (
        ("opacities", opacities, 0.0, 1.0),
        ("scales", scales, 0.0, float("inf")),
        ("lengths of quaternions", lengths, 1 - _UNIT, 1 + _UNIT),
    ):
        least, most = float(values.min()), float(values.max())
        if not low <= least <= most <= high:
            raise ExportError(
                f"frame {frame}: expected {quantity} from {low:g} to {high:g}, found {least:g} to {most:g}: "
                "pass the physical values that `Gaussians` documents"
            )
