"""Driving signals: a motion as what each step of a rollout sees of it.

A *motion window* is what one step sees: T_world_rest of every joint in a frame and in the two frames before
it, newest first, and then running means of these transforms, relative to the pelvis's position, one for each
time constant: where inertia would have left the cloth. A *driving signal* holds the motion window of every
frame.

Where a body jumps (a teleport, a glitch of the capture), its past jumps with it: nothing on earth moves so
fast, and cloth that were told of it would fly apart. The pose goes on, so that the cloth does, too.

Where the pose itself is cut, no past belongs to the new one: a limb carried there would sweep through the
cloth within a frame. The signal begins anew, as if the body had always stood so; a cut is where two shots
were joined, and each shot looks as it would alone.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.guards import LIMITS
from dsar.body.skinning import forward_kinematics
from dsar.geometry.rotations import heading_matrix
from dsar.types import Body, Motion

LOGGER = logging.getLogger(__name__)
_BODY_JOINTS = 22
"""Pelvis, legs, spine, head and arms; the face and the fingers come after them."""


@dataclass(frozen=True)
class DrivingSignal:
    """A motion of a body, its kinematics done: made once, and passed to all who need any of it."""

    name: str
    """The motion's."""
    fps: float
    """Frames per second."""
    transforms: Float[Tensor, "f j 4 4"]
    """T_world_rest by frame and joint."""
    windows: Float[Tensor, "f t j 4 4"]
    """The motion window of every frame."""
    jumps: tuple[int, ...]
    """Frames in which the body is where it cannot have come from the frame before."""
    steady: Float[Tensor, "f j 4 4"]
    """The transforms without what jumps have done to the body's place on the ground and its heading."""
    cloth: Float[Tensor, "f g 6"] | None = None
    """Where the avatar's motion prior has its garments, if it has one (see `dsar.avatar.motion_prior`)."""
    cuts: tuple[int, ...] = ()
    """Frames that begin another shot: nothing before them is known there."""

    @property
    def shots(self) -> list[slice]:
        """The frames between cuts."""
        ends = [*self.cuts, len(self)]
        return [slice(first, end) for first, end in zip([0, *self.cuts], ends, strict=True)]

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.transforms)

    @classmethod
    def of_motion(cls, body: Body, motion: Motion, time_constants: Sequence[float]) -> "DrivingSignal":
        """Return the driving signal of a body's motion; one that jumps is logged.

        Args:
            body: Who moves; its precision and device are the signal's.
            motion: Poses at a fixed rate.
            time_constants: Of the running means, seconds.
        """
        rotations, translations = motion.rotations.to(body.joints), motion.translations.to(body.joints)
        transforms = forward_kinematics(body, rotations, translations)
        cuts = find_cuts(transforms, body.joints, motion.fps)
        ends = [*cuts, len(transforms)]
        shots = [
            cls.of_transforms(transforms[first:end], body.joints[0], motion.fps, time_constants, motion.name)
            for first, end in zip([0, *cuts], ends, strict=True)
        ]
        signal = shots[0] if not cuts else cls._join(shots, cuts)
        if cuts:
            LOGGER.warning(
                "Motion %s: the pose is cut at frame %d of %d (%.2f s)%s; the clothes begin anew there",
                *(motion.name, cuts[0], len(motion), cuts[0] / motion.fps),
                f" and at {len(cuts) - 1} more" if len(cuts) > 1 else "",
            )
        for frame in signal.jumps:
            LOGGER.warning(
                "Motion %s: the body jumps at frame %d of %d (%.2f s); its clothes go with it",
                *(motion.name, frame, len(motion), frame / motion.fps),
            )
        return signal

    @classmethod
    def of_transforms(
        cls,
        transforms: Float[Tensor, "f j 4 4"],
        pelvis: Float[Tensor, "3"],
        fps: float,
        time_constants: Sequence[float],
        name: str = "motion",
    ) -> "DrivingSignal":
        """Return the driving signal of joints; before its first frame the body is taken to have stood in it.

        A mean forgets by a factor of e in its time constant. It is of transforms relative to the pelvis's
        position in the world, and is moved to the newest such position: a steady walk does not lag behind
        itself.

        Args:
            transforms: T_world_rest by frame and joint; the pelvis is joint 0.
            pelvis: Its position at rest, metres.
            fps: Frames per second.
            time_constants: Of the running means, seconds.
            name: The motion's.
        """
        jumps = find_jumps(transforms, pelvis, fps)
        if not jumps:
            windows = _windows(transforms, pelvis, fps, time_constants)
            return cls(name, fps, transforms, windows, (), transforms)
        jumped = _accumulated_jumps(transforms, pelvis, jumps)
        steady = jumped.inverse()[:, None] @ transforms
        windows = jumped[:, None, None] @ _windows(steady, pelvis, fps, time_constants)
        return cls(name, fps, transforms, windows, tuple(jumps), steady)

    @classmethod
    def _join(cls, shots: Sequence["DrivingSignal"], cuts: Sequence[int]) -> "DrivingSignal":
        """Return the signal of shots that begin at frame 0 and at cuts."""
        starts = zip([0, *cuts], shots, strict=True)
        return cls(
            name=shots[0].name,
            fps=shots[0].fps,
            transforms=torch.cat([shot.transforms for shot in shots]),
            windows=torch.cat([shot.windows for shot in shots]),
            jumps=tuple(start + jump for start, shot in starts for jump in shot.jumps),
            steady=torch.cat([shot.steady for shot in shots]),
            cuts=tuple(cuts),
        )

    def cloth_at(self, frames: Sequence[int]) -> Float[Tensor, "b g 6"] | None:
        """Return the motion prior in some frames."""
        if self.cloth is None:
            return None
        if isinstance(frames, range):
            return self.cloth[frames.start : frames.stop : frames.step]
        return self.cloth[list(frames)]


def find_jumps(transforms: Float[Tensor, "f j 4 4"], pelvis: Float[Tensor, "3"], fps: float) -> list[int]:
    """Return the frames in which a body is where it cannot have come from the frame before."""
    rotations, positions = transforms[:, 0, :3, :3], _pelvis_positions(transforms, pelvis)
    far = positions.diff(dim=0).norm(dim=-1) > LIMITS.jump_speed / fps
    # The trace of a rotation by an angle is 1 + 2 cos(angle).
    change = rotations[:-1].mT @ rotations[1:]
    cosines = (change.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    turned = cosines < math.cos(min(LIMITS.jump_angular_speed / fps, math.pi))
    return [int(frame) + 1 for frame in (far | turned).nonzero()]


def find_cuts(transforms: Float[Tensor, "f j 4 4"], joints: Float[Tensor, "j 3"], fps: float) -> list[int]:
    """Return the frames whose pose cannot have come from the frame before.

    Args:
        transforms: T_world_rest by frame and joint.
        joints: Their positions at rest, metres.
        fps: Frames per second.
    """
    relative = transforms[:, :1].inverse() @ transforms[:, :_BODY_JOINTS]
    places = (relative[..., :3, :3] @ joints[:_BODY_JOINTS, :, None]).squeeze(-1) + relative[..., :3, 3]
    speeds = places.diff(dim=0).norm(dim=-1).mean(-1) * fps
    return [int(frame) + 1 for frame in (speeds > LIMITS.cut_speed).nonzero()]


def _windows(
    transforms: Float[Tensor, "f j 4 4"],
    pelvis: Float[Tensor, "3"],
    fps: float,
    time_constants: Sequence[float],
) -> Float[Tensor, "f t j 4 4"]:
    """Return the motion windows of a motion without jumps."""
    return torch.cat([_newest_frames(transforms), _running_means(transforms, pelvis, fps, time_constants)], 1)


def _newest_frames(transforms: Float[Tensor, "f j 4 4"]) -> Float[Tensor, "f 3 j 4 4"]:
    """Return each frame and the two before it, newest first."""
    frames = torch.arange(len(transforms), device=transforms.device)
    return transforms[(frames[:, None] - torch.arange(3, device=transforms.device)).clamp_min(0)]


def _running_means(
    transforms: Float[Tensor, "f j 4 4"],
    pelvis: Float[Tensor, "3"],
    fps: float,
    time_constants: Sequence[float],
) -> Float[Tensor, "f l j 4 4"]:
    root = torch.zeros_like(transforms)
    root[..., :3, 3] = _pelvis_positions(transforms, pelvis)[:, None]
    relative = transforms - root
    decay = transforms.new_tensor([math.exp(-1 / (seconds * fps)) for seconds in time_constants])[
        :, None, None, None
    ]
    mean = relative[0].expand(len(time_constants), *relative.shape[1:])
    means = []
    for newest in relative:
        mean = decay * mean + (1 - decay) * newest
        means.append(mean)
    return torch.stack(means) + root[:, None]


def _pelvis_positions(
    transforms: Float[Tensor, "f j 4 4"], pelvis: Float[Tensor, "3"]
) -> Float[Tensor, "f 3"]:
    return transforms[:, 0, :3, :3] @ pelvis + transforms[:, 0, :3, 3]


def _accumulated_jumps(
    transforms: Float[Tensor, "f j 4 4"], pelvis: Float[Tensor, "3"], jumps: list[int]
) -> Float[Tensor, "f 4 4"]:
    """Return, by frame, what jumps have done so far to the body's place on the ground and its heading.

    Without its jump the pelvis would have gone on straight and turning as it did in the frame before.
    """
    ground_frames = torch.eye(4).to(transforms).repeat(len(transforms), 1, 1)
    ground_frames[:, :3, :3] = heading_matrix(transforms[:, 0, :3, :3])
    ground_frames[:, :3:2, 3] = _pelvis_positions(transforms, pelvis)[:, ::2]
    jumped = torch.eye(4).to(transforms).repeat(len(transforms), 1, 1)
    for frame in jumps:
        last = max(frame - 2, 0)
        before, newest = jumped[[last, frame - 1]].inverse() @ ground_frames[[last, frame - 1]]
        expected = newest @ before.inverse() @ newest
        expected[:3, 3] = 2 * newest[:3, 3] - before[:3, 3]
        jumped[frame:] = ground_frames[frame] @ expected.inverse()
    return jumped
