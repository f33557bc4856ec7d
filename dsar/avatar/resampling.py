"""Deliveries at other frame rates than the avatar's: where their frames lie in a rollout, and what is there.

The network steps at the rate that it was trained at, whatever is delivered. Between two steps what it adds
to the template at rest is blended in a line (of scales their logarithms, of opacities their logits), and
posed by the motion at that very time: limbs go on arcs, not on chords between posed frames.
"""

from collections.abc import Collection
from dataclasses import dataclass
from fractions import Fraction

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.driving import DrivingSignal
from dsar.body.skinning import forward_kinematics
from dsar.errors import MotionError
from dsar.geometry.frame_rates import exact_rate
from dsar.network import NetworkOutput
from dsar.types import Body, Motion


@dataclass(frozen=True)
class RolloutTime:
    """Where a delivered frame lies in a rollout."""

    step: int
    """The rollout's frame at that time or, if there is none, right before it; counted from 0."""
    fraction: float
    """How much of the way to the next frame has passed, in [0, 1); 0: it is the rollout's own frame."""


def locate_frames(signal: DrivingSignal, delivered: Motion) -> list[RolloutTime]:
    """Return where each frame of a delivery lies in the rollout of a motion; both begin together.

    Times are exact: 24 and 24000/1001 frames a second meet 30 where they truly do. Across a jump of the body
    (a cut) nothing is blended: the nearer frame is taken.

    Raises:
        MotionError: the delivery goes on a frame of the rollout or more after the last.
    """
    ratio, last = exact_rate(signal.fps) / exact_rate(delivered.fps), len(signal) - 1
    if (len(delivered) - 1) * ratio >= last + 1:
        raise MotionError(
            f"motion {signal.name}: expected a delivery of its {len(signal) / signal.fps:g} s, found "
            f"{len(delivered)} frames at {delivered.fps:g} a second: resample the same motion for both"
        )
    return [_locate(frame * ratio, (*signal.jumps, *signal.cuts)) for frame in range(len(delivered))]


def delivery_transforms(
    body: Body, signal: DrivingSignal, delivered: Motion, times: list[RolloutTime]
) -> Float[Tensor, "f j 4 4"]:
    """Return T_world_rest of every joint at given times of a rollout: its own where they are its frames."""
    own = torch.tensor([time.fraction == 0 for time in times], device=signal.transforms.device)
    steps = torch.tensor([time.step for time in times], device=signal.transforms.device)
    if own.all():
        return signal.transforms[steps]
    poses = delivered.rotations.to(body.joints), delivered.translations.to(body.joints)
    transforms = forward_kinematics(body, *poses)
    transforms[own] = signal.transforms[steps[own]]
    return transforms


def copy_residuals(output: NetworkOutput) -> NetworkOutput:
    """Return a copy of what poses Gaussians, which lasts while the network goes on."""
    return NetworkOutput(output.offset.clone(), output.appearance.clone(), ())


def interpolate_residuals(first: NetworkOutput, second: NetworkOutput, fraction: float) -> NetworkOutput:
    """Return the residuals a fraction of the way from one step to the next."""
    offset = torch.lerp(first.offset, second.offset, fraction)
    return NetworkOutput(offset, torch.lerp(first.appearance, second.appearance, fraction), ())


def _locate(time: Fraction, jumps: Collection[int]) -> RolloutTime:
    """Return where a time lies, in frames of the rollout."""
    step, fraction = int(time), time % 1
    if step + 1 in jumps:
        step, fraction = step + round(fraction), Fraction(0)
    return RolloutTime(step, float(fraction))
