"""Motion capture in .bvh files, whoever wrote them: a hierarchy of joints and their channels by frame."""

import logging
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.errors import MotionError
from dsar.geometry.frame_rates import exact_rate
from dsar.geometry.rotations import matrix_from_axis_angle
from dsar.text import decode_text

_CHANNELS = {f"{axis}{kind}".lower(): f"{axis}{kind}" for axis in "XYZ" for kind in ("position", "rotation")}
_POSITIONS = [f"{axis}position" for axis in "XYZ"]
_UNROTATED = 0.9
"""Share of a frame's rotations that are exactly zero: more are in a rest pose (CMU's turns legs and arms)."""
LOGGER = logging.getLogger(__name__)


@dataclass
class Skeleton:
    """The hierarchy of a .bvh file."""

    names: list[str] = field(default_factory=list)
    """Joints, each after its parent."""
    parents: list[int] = field(default_factory=list)
    """Their parents; -1 at the root."""
    offsets: list[list[float]] = field(default_factory=list)
    """Their places at rest relative to their parents, in the file's unit."""
    channels: list[list[str]] = field(default_factory=list)
    """What the columns of a frame say of them."""
    tips: dict[int, list[float]] = field(default_factory=dict)
    """Where the bones of the last joints end (`End Site`), relative to them."""


@dataclass(frozen=True)
class BvhMotion:
    """What a .bvh file holds."""

    skeleton: Skeleton
    values: Float[np.ndarray, "f c"]
    """The channels by frame: degrees, and the file's unit."""
    fps: float


def read_bvh(path: Path, fps: float | None = None) -> BvhMotion:
    """Return the skeleton and the frames of a file.

    A first frame with almost no rotations is left out where the next has them: it is the T-pose that
    conversions put in front of a recording.

    Args:
        path: The file; any encoding of its names, any line ends.
        fps: Frames per second, where the file says none or a wrong one.

    Raises:
        MotionError: the file is missing or malformed, has several roots, no bones or no frames.
    """
    if not path.is_file():
        raise MotionError(f"motion file {path}: no such file")
    text = "\n".join(_decode(path.read_bytes()).splitlines())
    start = re.search(r"^\s*MOTION\b", text, re.MULTILINE | re.IGNORECASE)
    try:
        if not start:
            raise ValueError("it has no MOTION")
        skeleton = _parse_hierarchy(text[: start.start()])
        lines = [line for line in text[start.end() :].splitlines() if line.strip()]
        count, seconds = int(lines[0].split(":")[-1]), float(lines[1].split(":")[-1])
        rows = [[float(number) for number in line.split()] for line in lines[2:]]
    except (ValueError, IndexError) as error:
        raise MotionError(f"motion file {path}: cannot be read as .bvh ({error})") from error
    columns = sum(map(len, skeleton.channels))
    uneven = [number for number, row in enumerate(rows) if len(row) != columns]
    if uneven:
        raise MotionError(
            f"motion file {path}: frame {uneven[0]} has {len(rows[uneven[0]])} numbers, expected {columns}"
        )
    if 0 < count < len(rows):
        LOGGER.warning(
            "%s: announces %d frames and has %d; the last are left out", path.name, count, len(rows)
        )
        rows = rows[:count]
    if len(rows) != count or not rows:
        raise MotionError(f"motion file {path}: has {len(rows)} frames, expected {count} and at least one")
    values = np.array(rows)
    not_finite = np.argwhere(~np.isfinite(values))
    if len(not_finite):
        raise MotionError(f"motion file {path}: frame {not_finite[0][0]} is not a finite number; cut it out")
    values = _without_scales(path, skeleton, values)
    rotating = [channel.endswith("rotation") for channels in skeleton.channels for channel in channels]
    unrotated = (values[:2, rotating] == 0).mean(axis=1)
    if len(values) > 1 and unrotated[0] > _UNROTATED >= unrotated[1]:
        LOGGER.info(
            "%s: its first frame, almost without rotations, is a rest pose and is left out", path.name
        )
        values = values[1:]
    return BvhMotion(skeleton, values, fps or _rate(path, seconds))


def _decode(content: bytes) -> str:
    """Return the text; names of joints may be in any encoding, all else is ASCII."""
    try:
        return decode_text(content)
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _rate(path: Path, seconds: float) -> float:
    """Return the frames per second; files give the time of a frame in few digits, .0083333 for 1/120."""
    if not 0 < seconds < 1:
        raise MotionError(
            f"motion file {path}: the frame time {seconds:g} is not a finite number above 0 and "
            "below one second; say its frames per second with --motion-fps"
        )
    return float(exact_rate(1 / seconds))


def _parse_hierarchy(text: str) -> Skeleton:
    """Return the hierarchy; raise ValueError with the joint and the fault."""
    skeleton, stack, in_tip = Skeleton(), [], False
    for words in map(str.split, re.sub(r"([{}])", r"\n\1\n", text).splitlines()):
        match [words[0].upper(), *words[1:]] if words else []:
            case ["ROOT" | "JOINT" as kind, *name]:
                if (kind == "ROOT") == bool(skeleton.names):
                    names = " and ".join([*skeleton.names[:1], " ".join(name)])
                    raise ValueError(f"it has several roots, {names}; expected one figure, split the file")
                if len(skeleton.names) != len(skeleton.channels):
                    raise ValueError(f"the joint {skeleton.names[-1]} lacks its CHANNELS")
                skeleton.names.append(" ".join(name))
                skeleton.parents.append(stack[-1] if stack else -1)
            case ["END", *_]:
                in_tip = True
            case ["{"]:
                stack.append(len(skeleton.names) - 1)
            case ["}"]:
                if not stack:
                    raise ValueError(f"a brace too many is closed after the joint {skeleton.names[-1]}")
                stack.pop()
                in_tip = False
            case ["OFFSET", *numbers]:
                position = [float(number) for number in numbers]
                if len(position) != 3 or not np.isfinite(position).all():
                    raise ValueError(f"the joint {skeleton.names[-1]} needs an OFFSET of three numbers")
                if in_tip:
                    skeleton.tips[stack[-1]] = position
                else:
                    skeleton.offsets.append(position)
            case ["CHANNELS", count, *channels]:
                skeleton.channels.append(_check_channels(skeleton.names[-1], int(count), channels))
    if stack:
        raise ValueError(f"the brace of the joint {skeleton.names[stack[-1]]} is not closed")
    if len({len(skeleton.names), len(skeleton.offsets), len(skeleton.channels)}) != 1 or not skeleton.names:
        raise ValueError("a joint lacks its name, its OFFSET of three numbers or its CHANNELS")
    if not any(set(_POSITIONS) <= set(channels) for channels in skeleton.channels):
        raise ValueError("its root has no position")
    return skeleton


def _check_channels(joint: str, count: int, channels: list[str]) -> list[str]:
    known = [_CHANNELS.get(channel.lower(), channel) for channel in channels]
    if count != len(known):
        raise ValueError(f"the joint {joint} announces {count} channels and names {len(known)}")
    strange = [
        name for name in known if name not in _CHANNELS.values() and not name.lower().endswith("scale")
    ]
    if strange:
        raise ValueError(
            f"the joint {joint} has channels {', '.join(strange)}; expected positions and rotations"
        )
    positions = [name for name in known if name in _POSITIONS]
    if len(set(known)) != len(known) or len(positions) not in (0, 3):
        raise ValueError(f"the joint {joint} has the channels {', '.join(known)}; expected each axis once")
    return known


def _without_scales(
    path: Path, skeleton: Skeleton, values: Float[np.ndarray, "f c"]
) -> Float[np.ndarray, "f d"]:
    """Return the values without scales, which must be constant: bones do not stretch."""
    scales = np.array([name not in _CHANNELS.values() for names in skeleton.channels for name in names])
    if not scales.any():
        return values
    if np.ptp(values[:, scales], axis=0).max() > 1e-3 * np.abs(values[:, scales]).max():
        raise MotionError(
            f"motion file {path}: its joints change their scale; export it without scale channels"
        )
    LOGGER.warning("%s: %d scale channels, all constant, are left out", path.name, scales.sum())
    skeleton.channels = [
        [name for name in names if name in _CHANNELS.values()] for names in skeleton.channels
    ]
    return values[:, ~scales]


def pose_skeleton(
    skeleton: Skeleton, values: Float[np.ndarray, "f c"]
) -> tuple[Float[Tensor, "f j 3 3"], Float[Tensor, "f j 3"]]:
    """Return the rotation of every joint in the world, by frame, and its place in the file's unit.

    A joint's position channels stand in place of its OFFSET, which stays where they are zero throughout.
    """
    axes = dict(zip("XYZ", torch.eye(3, dtype=torch.float64), strict=True))
    columns = torch.from_numpy(values).split([len(channels) for channels in skeleton.channels], dim=1)
    rotations: list[Tensor] = []
    positions: list[Tensor] = []
    for parent, offset, channels, column in zip(
        skeleton.parents, skeleton.offsets, skeleton.channels, columns, strict=True
    ):
        rotation = torch.eye(3, dtype=torch.float64).expand(len(values), 3, 3)
        for channel, value in zip(channels, column.T, strict=True):
            if channel.endswith("rotation"):
                rotation = rotation @ matrix_from_axis_angle(value.deg2rad()[:, None] * axes[channel[0]])
        position = torch.tensor(offset, dtype=torch.float64).expand(len(values), 3)
        if set(_POSITIONS) <= set(channels):
            moved = column[:, [channels.index(channel) for channel in _POSITIONS]]
            position = moved if parent < 0 or moved.any() else position
        rotations.append(rotation if parent < 0 else rotations[parent] @ rotation)
        positions.append(
            position if parent < 0 else positions[parent] + (rotations[parent] @ position[..., None])[..., 0]
        )
    return torch.stack(rotations, 1), torch.stack(positions, 1)
